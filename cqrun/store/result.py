"""What a run found: one model for each job. This module alone writes the files that hold them, and reads them.

The file is result.json, for a gradient check gradcheck.json.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, ClassVar, Literal, TypeVar, get_args

from pydantic import ConfigDict, Field, TypeAdapter

from cqrun.errors import UsageError
from cqrun.store.atomic import write_json
from cqrun.store.model_file import Part, optional, read_model

RESULT, GRADCHECK = "result.json", "gradcheck.json"

Value = float | list[float]
"""Of an unknown: one number, or one for each group or particle."""

Interval = tuple[float, float]
"""Lower and upper end."""


class Search(Part):
    """What every search tells: how it ended, where its loss is, and after how many iterations.

    What was found depends on `substeps`, the number of them in a control step; older runs do not say it.
    """

    file: ClassVar[str] = RESULT
    job: str
    status: str
    message: str
    loss: float | None
    iterations: int
    substeps: int | None = optional()

    def how_found(self) -> Iterator[str]:
        """Yield a line on the substeps with which values were found."""
        if self.substeps is not None:
            yield f"found with time.substeps={self.substeps}: keep that number wherever these values are used"


# --- sysid ----------------------------------------------------------------------------------------------------------


class Identified(Part):
    """An unknown: its start, its value, the 95 % interval of each of its numbers, and why there is none."""

    initial: Value
    value: Value
    interval: Interval | list[Interval | None] | None = None
    reason: str | None = optional()

    def numbers(self) -> tuple[list[float], list[Interval | None], list[float]]:
        """Return the unknown's numbers with an interval or None for each, and their starts."""
        values, initials = (v if isinstance(v, list) else [v] for v in (self.value, self.initial))
        if isinstance(self.interval, list):
            return values, self.interval, initials
        return values, [self.interval] * len(values), initials


class RecordingError(Part):
    """How far the model is from a recording, under keys that its measurement names, with their unit.

    For markers they are `rmse_mm`, None where the model blew up; `markers_mm`, the RMSE of each marker, None where it
    was not seen; and `alignment_mm`, how far each is from its rest position, where the recording was aligned.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, float | dict[str, float | None] | None]

    holdout: bool

    def number(self, key: str) -> float | None:
        """Return the number of a key; None if it has none."""
        value = (self.model_extra or {}).get(key)
        return value if isinstance(value, float) else None

    def numbers(self, key: str) -> dict[str, float | None]:
        """Return the number of each channel, or None for it, of a key; empty if it has none."""
        value = (self.model_extra or {}).get(key)
        return value if isinstance(value, dict) else {}


class SysidResult(Search):
    """What an identification found.

    Attributes:
        unknowns: by key path.
        recordings: by name; None where nothing was predicted, or there are no data.
        fracture: by body, the most pairs of neighbours that were lost at one time; None where nothing was predicted.
        findings: what the data leave open, and what went wrong, as sentences.
    """

    job: Literal["sysid"] = "sysid"
    unknowns: dict[str, Identified]
    recordings: dict[str, RecordingError] | None = None
    fracture: dict[str, int] | None = None
    findings: list[str] = Field(default_factory=list)


# --- control and codesign -------------------------------------------------------------------------------------------


class AtBounds(Part):
    """How many of an unknown's numbers are at each of its bounds."""

    lower: int
    upper: int


class Designed(Part):
    """An unknown of the design: its start and its value."""

    initial: Value
    value: Value
    at_bounds: AtBounds


class ConstraintValue(Part):
    """A constraint: its ends, the mean of its term over episodes, by how much that violates it, and the mean before."""

    at_least: float | None = optional()
    at_most: float | None = optional()
    equals: float | None = optional()
    value: float
    violation: float
    start: float | None = optional()


StageName = Literal["start", "trained", "unseen"]
"""Before the training, after it, and after it on goals that were not trained on."""


class Episode(Part):
    """An episode: goals [m], loss, and the terms of the loss by name."""

    goals: dict[str, list[float]]
    loss: float
    terms: dict[str, float]


class Stage(Part):
    """Episodes under one controller: mean loss and terms, and each of them."""

    loss: float
    terms: dict[str, float]
    episodes: list[Episode]


class LostEpisode(Part):
    """An episode that blew up: its goals [m], and how."""

    goals: dict[str, list[float]]
    message: str


LearnedJob = Literal["control", "codesign"]
LEARNED: tuple[LearnedJob, ...] = get_args(LearnedJob)
"""Jobs that learn."""


class LearnedResult(Search):
    """What a run of control or co-design learned.

    Attributes:
        unknowns: of the design, by key path.
        start, trained, unseen: episodes before and after, and on goals that were not trained on; None without any.
        constraints: by name.
        blew_up: episodes that are in no mean, by stage.
    """

    job: LearnedJob
    unknowns: dict[str, Designed]
    start: Stage | None = None
    trained: Stage | None = None
    unseen: Stage | None = None
    constraints: dict[str, ConstraintValue] = Field(default_factory=dict)
    blew_up: dict[StageName, list[LostEpisode]] = Field(default_factory=dict)

    def stages(self) -> dict[StageName, Stage]:
        """Return the stages that have episodes, by name."""
        named: dict[StageName, Stage | None] = {"start": self.start, "trained": self.trained, "unseen": self.unseen}
        return {name: stage for name, stage in named.items() if stage is not None}


# --- simulate -------------------------------------------------------------------------------------------------------


class BodyMotion(Part):
    """Where a body ended [m], with what kinetic energy, its greatest speed [m/s] and its least J at any time."""

    centroid: list[float]
    kinetic_energy: float
    fastest: float
    least_volume_ratio: float


class SimulateResult(Part):
    """What a simulation did.

    Attributes:
        time: that was reached [s].
        bodies: by name.
        fracture: by body, the most pairs of neighbours that were lost at one time.
        findings: what went wrong, as sentences.
        goals, loss, terms, constraints: of the episode, where there is a controller.
    """

    file: ClassVar[str] = RESULT
    job: Literal["simulate"] = "simulate"
    status: str
    message: str
    time: float
    bodies: dict[str, BodyMotion]
    fracture: dict[str, int]
    findings: list[str]
    goals: dict[str, list[float]] | None = optional()
    loss: float | None = optional()
    terms: dict[str, float] | None = optional()
    constraints: dict[str, ConstraintValue] | None = optional()


# --- gradcheck ------------------------------------------------------------------------------------------------------


Verdict = Literal["agrees", "agrees at a kink", "flat", "too rough", "disagrees"]


class Direction(Part):
    """One direction of a gradient check.

    Attributes:
        block: key path that is moved, or `all together`.
        count: how many numbers it has.
        adjoint: directional derivative by the adjoint.
        differences: the same by differences, on the plateau; None where every step's rollout failed.
        error: |adjoint - differences| / the larger of the two, or None.
        step: of the plateau.
        noise: what rounding can make of a difference there, or the scan's own scatter.
        scan: extrapolated difference at every step; None where a rollout failed.
        verdict: `agrees`; `agrees at a kink`, as the loss has two slopes there, and the adjoint is one of them; `flat`,
            as both are below what rounding makes, and there is nothing to compare; `too rough`, as they differ by no
            more than a few times the scan's scatter, which is large, or it is as large as they are; `disagrees`.
        agrees: the verdict is one of the first three.
    """

    block: str
    count: int
    adjoint: float
    differences: float | None
    error: float | None
    step: float
    noise: float
    scan: list[float | None]
    verdict: Verdict
    agrees: bool


class GradcheckResult(Part):
    """What a gradient check found: whether all directions agree, the loss and what it is of, steps and directions."""

    file: ClassVar[str] = GRADCHECK
    job: Literal["gradcheck"] = "gradcheck"
    agrees: bool
    loss: float
    of: str
    steps: list[float]
    rows: list[Direction]


# --- files ----------------------------------------------------------------------------------------------------------

Result = SysidResult | LearnedResult | SimulateResult | GradcheckResult
_RESULT: TypeAdapter[Result] = TypeAdapter(Annotated[Result, Field(discriminator="job")])


def write_result(run: Path, result: Result) -> None:
    """Write what the run in a directory found.

    Raises:
        ValueError: a number is not finite. UsageError, RunError: the file cannot be written.
    """
    write_json(run / result.file, result.model_dump())


def read_result(run: Path) -> Result | None:
    """Return what the run in a directory found; None where it has no result.

    Raises:
        UsageError: its file is damaged, or of another program.
    """
    file = next((file for name in (RESULT, GRADCHECK) if (file := run / name).is_file()), None)
    return None if file is None else read_result_file(file)


def read_result_file(file: Path) -> Result:
    """Return the result in a file, wherever it lies.

    Raises:
        UsageError: the file is damaged, or of another program; with the key path and what is wrong there.
    """
    return read_model(file, _RESULT)


R = TypeVar("R", bound=Result)


def require_result(run: Path, model: type[R]) -> R:
    """Return what the run in a directory found.

    Raises:
        UsageError: it has no result, one of another job, or one that cannot be read.
    """
    result = read_result(run)
    if not isinstance(result, model):
        jobs = " or ".join(get_args(model.model_fields["job"].annotation))
        raise UsageError(f"{run}: has no result of {jobs}")
    return result


def values_in(result: Result | None) -> dict[str, Value]:
    """Return the values that a result has for the unknowns, by key path; empty where it has no unknowns."""
    if not isinstance(result, SysidResult | LearnedResult):
        return {}
    return {path: unknown.value for path, unknown in result.unknowns.items()}
