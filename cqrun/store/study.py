"""Files about several runs of one scene: the summary of its seeds, the variants of a design, several grids."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import TypeAdapter

from cqrun.scene.keypath import shortest
from cqrun.scene.schema import Scene
from cqrun.store.model_file import Part, optional, read_model, write_model
from cqrun.store.thinnest import Thinnest

ROUNDING = 1e-12
"""Numbers of a sweep that differ by less than this part of the largest of their kind are equal but for rounding."""


class Mean(Part):
    """The mean of a number over runs, and the ends of its confidence interval; None if there are too few runs."""

    mean: float | None
    low: float | None
    high: float | None


class Seed(Part):
    """The run of one seed: its directory, how it ended, and the mean loss and terms over the episodes of each stage.

    Attributes:
        reason: why it failed; None if it did not.
        blew_up: sentences about episodes that blew up; they are not part of any mean.
        extended: whether `cqrun resume` gave it more iterations than the scene has.
    """

    run: str
    status: str
    reason: str | None = optional()
    iterations: int | None = optional()
    blew_up: list[str] | None = optional()
    extended: bool | None = optional()
    start: dict[str, float] | None = optional()
    trained: dict[str, float] | None = optional()
    unseen: dict[str, float] | None = optional()


class SeedsSummary(Part):
    """The runs of one scene from several seeds, and their statistics.

    Attributes:
        scene: the stem of the scene file.
        confidence: confidence level of the intervals.
        seeds: the run of each seed.
        all: for each stage, mean and interval of the loss and of every term over the successful runs.
    """

    scene: str
    confidence: float
    seeds: dict[str, Seed]
    all: dict[Literal["start", "trained", "unseen"], dict[str, Mean]]


class VariantRuns(Part):
    """A variant of a design: the groups of unknowns that are free in it, its runs, and their statistics.

    Attributes:
        failed: why each failed run failed, by its name.
        feasible: number of runs that meet the constraints; None without constraints.
        gain: relative improvement over training only the controller; None if it is not defined.
        rate: the learning rate that was used, if several were tried.
        searched: the loss for each learning rate that was tried; None if that run failed.
    """

    free: list[str]
    runs: list[str]
    failed: dict[str, str]
    feasible: int | None
    terms: dict[str, Mean]
    constraints: dict[str, Mean]
    gain: Mean | None
    rate: str | None = None
    searched: dict[str, float | None] | None = optional()


class Ablation(Part):
    """The comparison of a design's variants.

    Attributes:
        scene: the stem of the scene file.
        confidence: confidence level of the intervals.
        compared: the term of the objective that is compared.
        better: whether greater or smaller values of this term are better.
        variants: the variants by name.
        effects: the change of this term when a group of unknowns is freed, by group.
    """

    scene: str
    confidence: float
    compared: str
    better: Literal["greater", "smaller"]
    variants: dict[str, VariantRuns]
    effects: dict[str, Mean]


class GridRun(Part):
    """The run on one grid.

    Attributes:
        dx: edge of a cell [m].
        run: its directory.
        status, reason: how it ended, and why if it failed.
        overrides: what was changed in the scene.
        thinnest: how well the grid resolves each body.
    """

    dx: float
    run: str
    status: str
    reason: str | None = optional()
    overrides: list[str]
    thinnest: dict[str, Thinnest]


class OnGrids(Part):
    """A quantity on several grids, and extrapolated to a cell size of zero.

    Attributes:
        unit: its unit; empty for a pure number.
        values: its value on each grid, finest last; None if a grid has none.
        value, error: extrapolated value and its stated error; None if it cannot be extrapolated.
        order: the order of convergence that was used.
        how: whether the order was assumed or observed (jobs/studies/extrapolation.py).
        note: why it was not extrapolated, or what else should be known.
    """

    unit: str
    values: list[float | None]
    value: float | None
    error: float | None
    order: float | None
    how: Literal["equal", "assumed", "observed", "uneven"] | None
    note: str | None = optional()


class Resolution(Part):
    """The runs of one scene on several grids, and what they show.

    Attributes:
        scene: the stem of the scene file.
        job: the job of the runs.
        grids: the runs, finest grid last.
        quantities: what the runs found, by name.
        notes: what was changed with the grid, and what differs between the grids for other reasons.
    """

    scene: str
    job: str
    grids: list[GridRun]
    quantities: dict[str, OnGrids]
    notes: list[str]


class Found(Part):
    """A number that runs of a sweep found: its unit; empty for a pure number."""

    unit: str


class SweptRun(Part):
    """The run at one point of a sweep.

    Attributes:
        values: the values of the point as YAML text, by key path.
        run: its directory.
        status, reason: how it ended, and why if it failed.
        found: the numbers that it found, by name.
    """

    values: dict[str, str]
    run: str
    status: str
    reason: str | None = optional()
    found: dict[str, float]


class Sweep(Part):
    """The runs of one scene at several points.

    Attributes:
        scene: the stem of the scene file.
        job: the job of the runs.
        axes: key paths of the values, in the order of the command.
        units: units of those axes whose values are numbers, by key path; empty for pure numbers.
        found: the numbers that runs found, by name.
        runs: the runs, in the order of the points.
    """

    scene: str
    job: str
    axes: list[str]
    units: dict[str, str] | None = optional()
    found: dict[str, Found]
    runs: list[SweptRun]

    def unit(self, name: str) -> str:
        """Return the unit of an axis or of a number that was found; empty if it has none."""
        return self.found[name].unit if name in self.found else (self.units or {}).get(name, "")

    def titles(self) -> dict[str, str]:
        """Return a short name for each axis and each number that was found; of key paths the shortest different end."""
        paths = [name for name in self.found if name.partition(".")[0] in Scene.model_fields]
        short = dict(zip(self.axes, shortest(self.axes), strict=True)) | dict(zip(paths, shortest(paths), strict=True))
        return {name: short.get(name, name) for name in (*self.axes, *self.found)}

    def varying(self) -> list[str]:
        """Return the names of the numbers that differ between runs; all if none differs.

        Those of most runs come first, and of these what differs most, as a part of the largest number in its unit.
        Differences of rounding do not count, such as those of the largest displacement of what only moves down.
        """
        seen = {name: [run.found[name] for run in self.runs if name in run.found] for name in self.found}
        sizes: dict[tuple[str, str], float] = {}
        for name, values in seen.items():
            sizes[self._kind(name)] = max([sizes.get(self._kind(name), 0.0), *map(abs, values)])
        different = [n for n, v in seen.items() if v and max(v) - min(v) > ROUNDING * sizes[self._kind(n)]]
        spread = {name: max(values) - min(values) for name, values in seen.items() if values}
        units: dict[str, float] = {}
        for (_, unit), size in sizes.items():
            units[unit] = max(units.get(unit, 0.0), size)
        rank = {name: -spread[name] / (units[self.found[name].unit] or 1.0) for name in different}
        return sorted(different, key=lambda name: (-len(seen[name]), rank[name])) or list(self.found)

    def _kind(self, name: str) -> tuple[str, str]:
        """Return what numbers of one size share: the name without its last part, and the unit."""
        return name.rpartition(".")[0], self.found[name].unit


def write_study(file: Path, study: SeedsSummary | Ablation | Resolution | Sweep) -> None:
    """Write a summary of seeds, a comparison of variants, what several grids show, or a sweep.

    Raises:
        UsageError, RunError: the file cannot be written.
    """
    write_model(file, study)


def read_seeds(file: Path) -> SeedsSummary:
    """Return a summary of seeds; UsageError if the file is damaged, or another program wrote it."""
    return read_model(file, TypeAdapter(SeedsSummary))


def read_ablation(file: Path) -> Ablation:
    """Return a comparison of variants; UsageError if the file is damaged, or another program wrote it."""
    return read_model(file, TypeAdapter(Ablation))


def read_resolution(file: Path) -> Resolution:
    """Return what several grids show; UsageError if the file is damaged, or another program wrote it."""
    return read_model(file, TypeAdapter(Resolution))


def read_sweep(file: Path) -> Sweep:
    """Return a sweep; UsageError if the file is damaged, or another program wrote it."""
    return read_model(file, TypeAdapter(Sweep))
