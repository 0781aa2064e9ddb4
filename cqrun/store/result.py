"""The result of a run: one model for each job. Only this module writes and reads the files with results.

The file is result.json, or gradcheck.json for a gradient check.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar, get_args

from pydantic import ConfigDict, Field, TypeAdapter

from cqrun.errors import UsageError
from cqrun.store.measured import MeasuredNumber
from cqrun.store.model_file import Part, optional, read_model, write_model
from cqrun.store.reactions import BoundaryForce
from cqrun.store.rest_point import RestPoint
from cqrun.store.thinnest import Thinnest, thinnest_parts_field

RESULT, GRADCHECK = "result.json", "gradcheck.json"

Value = float | list[float]
"""The value of an unknown: one number, or one for each group or particle."""

Interval = tuple[float, float]
"""Lower and upper end."""


def measured_field() -> Any:
    """Return the field of a result for its measured quantities, by the name of each number; left out if it has none."""
    return Field(default_factory=dict, exclude_if=lambda measured: not measured)


class Search(Part):
    """The result of any search: how it ended, the final loss, and the number of iterations.

    The values found depend on `substeps`, the number of substeps in a control step; older runs do not record it.
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
    """An unknown: start, value, the 95 % interval of each of its numbers, and the reason if there is no interval."""

    initial: Value
    value: Value
    interval: Interval | list[Interval | None] | None = None
    reason: str | None = optional()

    def names(self, path: str) -> list[str]:
        """Return the name of each of the unknown's numbers: its key path, with an index if it has several."""
        return [f"{path}[{k}]" for k in range(len(self.value))] if isinstance(self.value, list) else [path]

    def numbers(self) -> tuple[list[float], list[Interval | None], list[float]]:
        """Return the unknown's numbers, an interval or None for each, and their start values."""
        values, initials = (v if isinstance(v, list) else [v] for v in (self.value, self.initial))
        if isinstance(self.interval, list):
            return values, self.interval, initials
        return values, [self.interval] * len(values), initials


class RecordingError(Part):
    """Errors of the model against a recording; the measurement defines the keys, which end in the unit.

    For markers these are `rmse_mm`, None if the model blew up; `markers_mm`, the RMSE of each marker, None if it was
    not seen; and, if the recording was aligned, `alignment_mm`, the distance of each marker from its rest position.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, float | dict[str, float | None] | None]

    holdout: bool

    def number(self, key: str) -> float | None:
        """Return the number of a key; None if it has none."""
        value = (self.model_extra or {}).get(key)
        return value if isinstance(value, float) else None

    def numbers(self, key: str) -> dict[str, float | None]:
        """Return the number, or None, of each channel for a key; empty if there are none."""
        value = (self.model_extra or {}).get(key)
        return value if isinstance(value, dict) else {}


class HeldNumber(Part):
    """A number that a fit holds fixed, so that its intervals are right only if this number is.

    Attributes:
        value: the number in the scene.
        other: another possible value.
        found: what the fit would find with that value, to first order, by the name of each number with an interval: its
            key path, with `[0]`, `[1]` ... if it has several.
        misfit: size of the residuals then, relative to those of the fit; None if the fit has none.
    """

    value: float
    other: float
    found: dict[str, float]
    misfit: float | None = optional()


class Modulus(Part):
    """A modulus that follows from the unknowns, and its interval, if that is known [Pa]."""

    value: float
    interval: Interval | None = None


class SysidResult(Search):
    """The result of an identification.

    Attributes:
        unknowns: the unknowns by key path.
        moduli: Young's moduli at small strains that follow from the unknowns, by body and kind.
        held: densities and elastic constants that the intervals hold fixed, by key path.
        recordings: the errors of each recording by name; None if nothing was predicted, or there are no data.
        fracture: for each body, the most pairs of neighbours lost at one time; None if nothing was predicted.
        findings: sentences about what the data do not determine, and about what went wrong.
    """

    job: Literal["sysid"] = "sysid"
    unknowns: dict[str, Identified]
    moduli: dict[str, dict[str, Modulus]] = Field(default_factory=dict, exclude_if=lambda moduli: not moduli)
    held: dict[str, HeldNumber] = Field(default_factory=dict, exclude_if=lambda held: not held)
    recordings: dict[str, RecordingError] | None = None
    fracture: dict[str, int] | None = None
    findings: list[str] = Field(default_factory=list)
    thinnest: dict[str, Thinnest] = thinnest_parts_field()
    measured: dict[str, MeasuredNumber] = measured_field()


# --- control and codesign -------------------------------------------------------------------------------------------


class AtBounds(Part):
    """The number of an unknown's entries that are at each of its bounds."""

    lower: int
    upper: int


class Designed(Part):
    """An unknown of the design: its start and its value."""

    initial: Value
    value: Value
    at_bounds: AtBounds


class ConstraintValue(Part):
    """A constraint: its bounds, the mean of its term over episodes, the violation, and the mean before training."""

    at_least: float | None = optional()
    at_most: float | None = optional()
    equals: float | None = optional()
    value: float
    violation: float
    start: float | None = optional()


StageName = Literal["start", "trained", "unseen"]
"""Before training, after training, and after training but on goals that were not used for it."""


class Episode(Part):
    """An episode: goals [m], loss, and the terms of the loss by name."""

    goals: dict[str, list[float]]
    loss: float
    terms: dict[str, float]


class Stage(Part):
    """Episodes with one controller: mean loss, mean terms, and every episode."""

    loss: float
    terms: dict[str, float]
    episodes: list[Episode]


class LostEpisode(Part):
    """An episode that blew up: its goals [m], and the message."""

    goals: dict[str, list[float]]
    message: str


LearnedJob = Literal["control", "codesign"]
LEARNED: tuple[LearnedJob, ...] = get_args(LearnedJob)
"""Jobs that learn."""


class LearnedResult(Search):
    """The result of control or co-design.

    Attributes:
        unknowns: the unknowns of the design, by key path.
        start, trained, unseen: episodes of each stage (`StageName`); None if it has none.
        constraints: the constraints by name.
        blew_up: episodes that blew up, by stage; they are not part of any mean.
    """

    job: LearnedJob
    unknowns: dict[str, Designed]
    start: Stage | None = None
    trained: Stage | None = None
    unseen: Stage | None = None
    constraints: dict[str, ConstraintValue] = Field(default_factory=dict)
    blew_up: dict[StageName, list[LostEpisode]] = Field(default_factory=dict)
    measured: dict[str, MeasuredNumber] = measured_field()

    def stages(self) -> dict[StageName, Stage]:
        """Return the stages that have episodes, by name."""
        named: dict[StageName, Stage | None] = {"start": self.start, "trained": self.trained, "unseen": self.unseen}
        return {name: stage for name, stage in named.items() if stage is not None}


# --- simulate -------------------------------------------------------------------------------------------------------


class BodyMotion(Part):
    """A body at the end: position [m] and kinetic energy; and over the whole run: top speed [m/s] and smallest J."""

    centroid: list[float]
    kinetic_energy: float
    fastest: float
    least_volume_ratio: float


class SimulateResult(Part):
    """The result of a simulation.

    Attributes:
        time: the time that was reached [s].
        bodies: the bodies by name.
        fracture: for each body, the most pairs of neighbours lost at one time.
        findings: sentences about what went wrong.
        boundaries: forces of the boundaries by name, in the reference frame.
        goals, loss, terms, constraints: those of the episode, if the scene has a controller.
    """

    file: ClassVar[str] = RESULT
    job: Literal["simulate"] = "simulate"
    status: str
    message: str
    time: float
    bodies: dict[str, BodyMotion]
    fracture: dict[str, int]
    findings: list[str]
    thinnest: dict[str, Thinnest] = thinnest_parts_field()
    measured: dict[str, MeasuredNumber] = measured_field()
    boundaries: dict[str, BoundaryForce] | None = optional()
    goals: dict[str, list[float]] | None = optional()
    loss: float | None = optional()
    terms: dict[str, float] | None = optional()
    constraints: dict[str, ConstraintValue] | None = optional()


# --- rest ------------------------------------------------------------------------------------------------------------


class RestResult(Part):
    """The equilibria along a path: its points, and sentences about what is notable."""

    file: ClassVar[str] = RESULT
    job: Literal["rest"] = "rest"
    status: str
    message: str
    points: list[RestPoint]
    findings: list[str]
    thinnest: dict[str, Thinnest] = thinnest_parts_field()
    measured: dict[str, MeasuredNumber] = measured_field()


# --- gradcheck ------------------------------------------------------------------------------------------------------


Verdict = Literal["agrees", "agrees at a kink", "flat", "too rough", "disagrees"]


class Direction(Part):
    """One direction of a gradient check.

    Attributes:
        block: key path that is varied, or `all together`.
        count: number of its entries.
        adjoint: directional derivative from the adjoint.
        differences: directional derivative from differences, on the plateau; None if rollouts failed for every step.
        error: |adjoint - differences| / the larger of the two, or None.
        step: step size of the plateau.
        noise: possible effect of rounding on the difference there, or the scatter of the scan.
        scan: extrapolated difference for every step; None if a rollout failed.
        verdict: `agrees`; `agrees at a kink`: the loss has two slopes there, and the adjoint is one of them; `flat`:
            both are below the effect of rounding, so they cannot be compared; `too rough`: the scatter of the scan is
            large, and the two differ by at most a few times the scatter, or are not larger than it; `disagrees`.
        agrees: whether the verdict is one of the first three.
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
    """The result of a gradient check: whether all directions agree, the loss and its name, steps and directions."""

    file: ClassVar[str] = GRADCHECK
    job: Literal["gradcheck"] = "gradcheck"
    agrees: bool
    loss: float
    of: str
    steps: list[float]
    rows: list[Direction]


# --- files ----------------------------------------------------------------------------------------------------------

Result = SysidResult | LearnedResult | SimulateResult | RestResult | GradcheckResult
_RESULT: TypeAdapter[Result] = TypeAdapter(Annotated[Result, Field(discriminator="job")])


def write_result(run: Path, result: Result) -> None:
    """Write the result of the run in a directory.

    Raises:
        ValueError: a number is not finite. UsageError, RunError: the file cannot be written.
    """
    write_model(run / result.file, result)


def read_result(run: Path) -> Result | None:
    """Return the result of the run in a directory; None if it has no result.

    Raises:
        UsageError: its file is damaged, or another program wrote it.
    """
    file = result_file(run)
    return None if file is None else read_result_file(file)


def result_file(run: Path) -> Path | None:
    """Return the file with the result of the run in a directory; None if it has no result."""
    return next((file for name in (RESULT, GRADCHECK) if (file := run / name).is_file()), None)


def read_result_file(file: Path) -> Result:
    """Return the result in a file, in any folder.

    Raises:
        UsageError: the file is damaged, or another program wrote it; the message gives the key path.
    """
    return read_model(file, _RESULT)


R = TypeVar("R", bound=Result)


def require_result(run: Path, model: type[R]) -> R:
    """Return the result of the run in a directory.

    Raises:
        UsageError: it has no result, a result of another job, or a result that cannot be read.
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
