"""Sections `data` and `unknowns`: recordings or synthetic data to fit, and the values that a fit may change."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from cqrun.explain import KEY, Loc, complaint, finding, listed
from cqrun.measurements.placement import PLACED
from cqrun.plugin.contract import Spec, quantity, vector
from cqrun.plugin.reference import FileName, FilledIn, NamesBody
from cqrun.plugin.registry import plugins
from cqrun.scene.fields import Interval, Name, Seed, Vector, turning_problems
from cqrun.scene.plugin_keys import PluginKeys
from cqrun.units import LengthUnit

if TYPE_CHECKING:
    from cqrun.measurements.measurement import Measurement

CarrierName = Annotated[Name, NamesBody(), FilledIn("only body")]
"""Name of the body that data belong to; a scene with a single body may omit it."""


def exactly_one(part: Spec, names: tuple[str, ...]) -> None:
    """Raise unless exactly one of the fields is given."""
    given = [name for name in names if getattr(part, name) is not None]
    if len(given) != 1:
        message = f"must have exactly one of {listed(names)}; has {listed(given)}"
        raise complaint(type(part).__name__, [finding(message, involves=names)])


class Recording(PluginKeys):
    """A recording: measured data, read from a file.

    One further key is the name of a measurement, such as `markers: {tip: [0.1, 0.02]}`. The measurement defines what
    the file contains, and how the model is compared with it (cqrun describe measurement).

    A recording may have values of its own, which no other recording has. `overrides` gives them. To fit one, name it in
    `unknowns` as `data.recordings.NAME.overrides.PATH`, such as `data.recordings.swing.overrides.world.gravity.1` for
    the tilt of one recording, or `....overrides.loads.push.point_force.force.0` for a pre-load. It starts from the
    override if there is one, or else from the scene's value. `data.recordings.NAME.start`, `....offset.0` and
    `....rotation.0` can be unknowns, too. If every recording is `holdout: true`, nothing is fitted: `cqrun sysid`
    predicts the recordings with the scene's values.
    """

    keys_of: ClassVar[str] = "measurement"

    file: FileName = Field(
        min_length=1,
        description="File with the measured data, from the scene's folder; docs/recordings.md shows every format",
    )
    start: float = quantity(
        "s",
        "Time in the file at which the run begins; the first frame of a C3D or Vicon file is at 0",
        differentiable=True,
        default=0.0,
    )
    length: float | None = quantity("s", "Duration to compare; the scene's duration if absent", gt=0, default=None)
    skip: float = quantity("s", "Time to leave out, counted from the latest allowed start", ge=0, default=0.0)
    holdout: bool = Field(description="Predict this recording, but do not fit it", default=False)
    body: CarrierName = Field(description="Measured body; the only body if absent")
    units: LengthUnit | None = Field(description="Length unit of the file, if it does not name one", default=None)
    still: Interval | None = quantity("s", "[begin, end] at rest in the file, before or after the run", default=None)
    offset: Annotated[list[float], FilledIn("zero vector")] = vector(
        "m", "Added to the measured positions, in the axes of the scene; zero if absent", differentiable=True,
        exclude_if=lambda offset: not any(offset),  # so that scenes without any keep the names of their runs
    )  # fmt: skip
    rotation: Annotated[list[float], FilledIn("zero spin")] = quantity(
        "rad", "Turns the measured positions about the origin of the file, before `offset`: an angle in 2D, a rotation "
        "vector in 3D; zero if absent", differentiable=True, min_length=1, max_length=3,
        exclude_if=lambda rotation: not any(rotation),
    )  # fmt: skip
    overrides: dict[str, Any] = Field(description="Key path -> value in this recording", default_factory=dict)
    weight: float = quantity("1", "Weight in the loss", gt=0, default=1.0)

    @property
    def measurement(self) -> Measurement:
        """The measurement; `markers` if none is named."""
        return next(iter(self.chosen.values()), None) or markers()

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        return [*super().dim_problems(dim), *turning_problems(self, ("rotation",), dim)]

    @model_validator(mode="after")
    def _measured_in_one_way(self) -> Self:
        if len(self.chosen) > 1:
            message = f"must have one measurement; has {listed(self.chosen)}: make a recording for each"
            raise complaint("Recording", [finding(message, involves=self.chosen)])
        given = {"still": self.still is not None, "units": self.units is not None}
        given |= {what: any(getattr(self, what)) for what in PLACED}
        for name, is_given in given.items():
            if is_given and name not in self.measurement.takes:
                message = f"has no meaning for the measurement `{self.measurement.name}`: remove it"
                raise complaint("Recording", [finding(message, (name,), kind=KEY)])
        timed = {"start": self.start != 0.0, "length": self.length is not None, "skip": self.skip != 0.0}
        for name, is_given in timed.items():
            if is_given and self.measurement.compares_rest:
                message = f"has no meaning for the measurement `{self.measurement.name}`, which is at rest: remove it"
                raise complaint("Recording", [finding(message, (name,), kind=KEY)])
        return self

    @model_validator(mode="after")
    def _skip_leaves_something(self) -> Self:
        if self.length is not None and self.skip >= self.length:
            message = f"skips {self.skip:g} s of a length of {self.length:g} s: nothing is left to compare"
            raise complaint("Recording", [finding(message, ("skip",), involves=("length",))])
        return self

    @model_validator(mode="after")
    def _still_is_ordered(self) -> Self:
        if self.still is not None and not self.still[0] < self.still[1]:
            raise complaint("Recording", [finding("must begin before it ends", ("still",))])
        return self


def markers() -> Measurement:
    """Return the measurement of recordings that name none, and of synthetic data."""
    markers: Measurement = plugins("measurement")["markers"]()
    return markers


class Synthetic(Spec):
    """Data that the scene makes with known values of its unknowns, plus noise."""

    truth: dict[str, float] = Field(description="Key path -> true value", min_length=1)
    noise: float = quantity("m", "Standard deviation of each coordinate", ge=0, default=0.0)
    copies: int = Field(description="Noisy copies of each sequence", ge=1, default=1)
    seed: Seed = Field(description="Seed of the noise and of tracked particles", default=0)
    body: CarrierName = Field(description="Body that carries the markers; the only body if absent")
    markers: dict[str, Vector] | None = quantity("m", "Rest position of each marker", min_length=1, default=None)
    tracked: int | None = Field(description="How many random particles to track", ge=1, default=None)
    every: int | None = Field(description="Control steps between two frames", ge=1, default=None)
    key_frames: int | None = Field(description="Frames, spread evenly from start to end of the run", ge=2, default=None)

    @model_validator(mode="after")
    def _one_of_each(self) -> Self:
        exactly_one(self, ("markers", "tracked"))
        exactly_one(self, ("every", "key_frames"))
        return self

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        message = f"must have {dim} entries in this {dim}D world, has "
        wrong = {name: len(x) for name, x in (self.markers or {}).items() if len(x) != dim}
        return super().dim_problems(dim) + [(("markers", name), f"{message}{n}") for name, n in wrong.items()]


class Data(Spec):
    """The data that a run is fitted to: exactly one of `recordings` and `synthetic`."""

    recordings: dict[Name, Recording] | None = Field(description="Name -> recording", min_length=1, default=None)
    synthetic: Synthetic | None = Field(description="Data made by the scene itself", default=None)

    @model_validator(mode="before")
    @classmethod
    def _no_target(cls, data: Any) -> Any:
        if isinstance(data, dict) and "target" in data:
            raise complaint("Data", [finding(_instead_of(data["target"]), ("target",), kind=KEY)])
        return data

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        exactly_one(self, ("recordings", "synthetic"))
        return self

    def measurement(self, name: str) -> Measurement:
        """Return the measurement of a recording, or of a sequence of synthetic data."""
        return markers() if self.recordings is None else self.recordings[name].measurement

    @property
    def measurements(self) -> list[Measurement]:
        """The measurements of all recordings."""
        return [markers()] if self.recordings is None else [r.measurement for r in self.recordings.values()]


def _instead_of(target: Any) -> str:
    """Return advice to replace a target by an objective: `reach` for the end of the run, `track` for a given time."""
    given = target if isinstance(target, dict) else {}
    position = given.get("position")
    numbers = [str(number) for number in position] if isinstance(position, list) else ["X", "Y"]
    term, place = "reach", f"position: [{', '.join(numbers)}]"
    if "time" in given:
        term, place = "track", f"keys: [[{', '.join([str(given['time']), *numbers])}]]"
    objective = f"objective: {{there: {{{term}: {{body: {given.get('body', 'BODY')}, {place}}}}}}}"
    return f"a target is an objective, not data: remove `data` and write `{objective}`; `cqrun sysid` minimises it"


class Tie(Spec):
    """Another number that follows an unknown: factor * unknown + offset."""

    factor: float = Field(description="Its change per unit change of the unknown", default=1.0)
    offset: float = Field(description="Its value if the unknown is 0, in its own unit", default=0.0)

    @model_validator(mode="after")
    def _follows(self) -> Self:
        if self.factor == 0:
            raise complaint("Tie", [finding("must not be 0, or the number is constant: set it directly", ("factor",))])
        return self


def _ties(value: Any) -> Any:
    """Return a list of key paths as ties with factor 1 and offset 0."""
    if isinstance(value, list) and all(isinstance(path, str) for path in value):
        return {path: {} for path in value}
    return value


class Unknown(Spec):
    """A number of the scene that an optimizer may change, under its key path.

    `data.recordings.NAME.overrides.PATH` is the value that one recording alone has at PATH: the fit changes it there,
    and nowhere else (cqrun describe recordings).
    """

    bounds: Interval = Field(description="Smallest and largest value, in the number's unit")
    scale: Literal["linear", "log"] = Field(description="Scale on which the optimizer searches", default="linear")
    per: Literal["body", "group", "particle", "field"] = Field(
        description="One value per body, per group or per particle, or a smooth field over the body", default="body"
    )
    resolution: int | None = Field(
        description="Only for `per: field`: spline cells along the body's longest edge; 4 if absent", ge=1, le=64,
        default=None,
    )  # fmt: skip
    mirror: Literal["x", "y", "z"] | None = Field(
        description="Axis along which the values are symmetric about the body's middle; the body must be, too",
        default=None,
    )
    also: Annotated[dict[str, Tie], BeforeValidator(_ties)] = Field(
        description="Key paths that change with it: a list if their values are equal, or path -> {factor, offset}",
        default_factory=dict,
    )
    initial: float | None = Field(description="Start value; the scene's own value if absent", default=None)
    regulariser: float = Field(
        description="Loss weight of the mean squared change from the start, relative to the bounds", ge=0, default=0.0
    )

    @model_validator(mode="before")
    @classmethod
    def _not_per_recording(cls, data: Any) -> Any:
        if isinstance(data, dict) and data.get("per") == "recording":
            message = "name the value of each recording: `data.recordings.NAME.overrides.` before the key path"
            raise complaint("Unknown", [finding(message, ("per",))])
        return data

    @model_validator(mode="after")
    def _bounds_are_ordered(self) -> Self:
        lower, upper = self.bounds
        if not lower < upper:
            message = f"the lower bound {lower:g} must be less than the upper bound {upper:g}"
            raise complaint("Unknown", [finding(message, ("bounds",))])
        if self.scale == "log" and lower <= 0:
            message = f"a log scale needs bounds greater than 0, is {lower:g}"
            raise complaint("Unknown", [finding(message, ("bounds", 0), involves=("scale",))])
        if self.resolution is not None and self.per != "field":
            raise complaint("Unknown", [finding("has a meaning only for `per: field`", ("resolution",))])
        if self.mirror is not None and self.per == "body":
            message = "has a meaning only for `per: group`, `per: particle` and `per: field`"
            raise complaint("Unknown", [finding(message, ("mirror",))])
        return self

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        wrong = [(("mirror",), "a 2D world has no axis z")] if self.mirror == "z" and dim == 2 else []
        return super().dim_problems(dim) + wrong
