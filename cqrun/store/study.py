"""What several runs of one scene share: the summary of its seeds, and the comparison of a design's variants."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import TypeAdapter

from cqrun.store.model_file import Part, optional, read_model, write_model


class Mean(Part):
    """The mean of a number over runs, and the ends of its interval; None where there are too few runs for it."""

    mean: float | None
    low: float | None
    high: float | None


class Seed(Part):
    """The run of one seed: its directory, how it ended, and by stage the mean loss and terms over its episodes.

    Attributes:
        reason: why it failed, else None.
        blew_up: sentences on episodes that are in no mean.
        extended: whether `cqrun resume` has given it more iterations than the scene has.
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
    """The runs of one scene from several seeds, and what they have in common.

    Attributes:
        scene: the file's stem.
        confidence: of the intervals.
        seeds: by seed.
        all: by stage, mean and interval of the loss and of every term over the runs that went well.
    """

    scene: str
    confidence: float
    seeds: dict[str, Seed]
    all: dict[Literal["start", "trained", "unseen"], dict[str, Mean]]


class VariantRuns(Part):
    """A variant of a design: which groups of unknowns are free in it, its runs, and what these have in common.

    Attributes:
        failed: why runs failed, by name.
        feasible: how many runs meet the constraints, None without any.
        gain: by which part it is better than the controller alone, None where that cannot be said.
        rate: the learning rate it was learned with, if several were tried.
        searched: the loss with each of them, None where it failed.
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
        scene: the file's stem.
        confidence: of the intervals.
        compared: the term of the objective that counts.
        better: whether a greater or a smaller one.
        variants: by name.
        effects: what freeing each group of unknowns adds to that term.
    """

    scene: str
    confidence: float
    compared: str
    better: Literal["greater", "smaller"]
    variants: dict[str, VariantRuns]
    effects: dict[str, Mean]


def write_study(file: Path, study: SeedsSummary | Ablation) -> None:
    """Write what several runs share.

    Raises:
        UsageError, RunError: the file cannot be written.
    """
    write_model(file, study)


def read_seeds(file: Path) -> SeedsSummary:
    """Return a summary of seeds; UsageError where the file is damaged, or of another program."""
    return read_model(file, TypeAdapter(SeedsSummary))


def read_ablation(file: Path) -> Ablation:
    """Return a comparison of variants; UsageError where the file is damaged, or of another program."""
    return read_model(file, TypeAdapter(Ablation))
