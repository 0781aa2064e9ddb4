"""Files about several runs of one scene: the summary of its seeds, and the comparison of a design's variants."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import TypeAdapter

from cqrun.store.model_file import Part, optional, read_model, write_model


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


def write_study(file: Path, study: SeedsSummary | Ablation) -> None:
    """Write a summary of seeds, or a comparison of variants.

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
