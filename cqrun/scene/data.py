"""What a run is fitted to: recordings, or data that the scene makes itself."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from cqrun.explain import KEY, Loc, complaint, finding, listed
from cqrun.plugin.contract import Spec, quantity
from cqrun.plugin.reference import FileName, FilledIn, NamesBody
from cqrun.plugin.registry import plugins
from cqrun.scene.fields import Interval, Name, Seed, Vector
from cqrun.scene.plugin_keys import PluginKeys
from cqrun.units import LengthUnit

if TYPE_CHECKING:
    from cqrun.measurements.measurement import Measurement

CarrierName = Annotated[Name, NamesBody(), FilledIn("only body")]
"""Name of the body that data belong to; in a scene with a single body it may be left out."""


def exactly_one(part: Spec, names: tuple[str, ...]) -> None:
    """Raise unless exactly one of the fields is given."""
    given = [name for name in names if getattr(part, name) is not None]
    if len(given) != 1:
        message = f"must have exactly one of {listed(names)}; has {listed(given)}"
        raise complaint(type(part).__name__, [finding(message, involves=names)])


class Recording(PluginKeys):
    """What was measured, read from a file.

    One further key is the name of a measurement, which says what the file holds and how the model is compared with it:
    `markers: {tip: [0.1, 0.02]}` (cqrun describe measurement).
    """

    keys_of: ClassVar[str] = "measurement"

    file: FileName = Field(min_length=1, description="File with what was measured, relative to the scene")
    start: float = quantity(
        "s", "Time in the file when the run begins; the first frame of C3D is at 0", differentiable=True, default=0.0
    )
    length: float | None = quantity("s", "How long to compare; the scene's duration if absent", gt=0, default=None)
    skip: float = quantity("s", "Time after the start (the latest that is allowed) not compared", ge=0, default=0.0)
    holdout: bool = Field(description="Predict it, but do not fit it", default=False)
    body: CarrierName = Field(description="Body that was measured; the only one if absent")
    units: LengthUnit | None = Field(description="Of lengths in the file, if it does not say", default=None)
    still: Interval | None = quantity("s", "Time in the file at rest, before the run or after it", default=None)
    overrides: dict[str, Any] = Field(description="Key path -> value for this recording", default_factory=dict)
    weight: float = quantity("1", "Weight in the loss", gt=0, default=1.0)

    @property
    def measurement(self) -> Measurement:
        """The measurement: `markers` where none is named."""
        return next(iter(self.chosen.values()), None) or markers()

    @model_validator(mode="after")
    def _measured_in_one_way(self) -> Self:
        if len(self.chosen) > 1:
            message = f"is of one measurement; has {listed(self.chosen)}: make a recording for each"
            raise complaint("Recording", [finding(message, involves=self.chosen)])
        for name in ("still", "units"):
            if getattr(self, name) is not None and name not in self.measurement.takes:
                message = f"has no meaning for the measurement `{self.measurement.name}`: remove it"
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
    body: CarrierName = Field(description="Body that carries the markers; the only one if absent")
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
        told = f"must have {dim} entries in this {dim}D world, has "
        wrong = {name: len(x) for name, x in (self.markers or {}).items() if len(x) != dim}
        return super().dim_problems(dim) + [(("markers", name), f"{told}{n}") for name, n in wrong.items()]


class Data(Spec):
    """What a run is fitted to: exactly one of `recordings` and `synthetic`."""

    recordings: dict[Name, Recording] | None = Field(description="What was measured", min_length=1, default=None)
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
    """Return what to write in the place of a target: where the body ends, or where it is at a time."""
    given = target if isinstance(target, dict) else {}
    position = given.get("position")
    numbers = [str(number) for number in position] if isinstance(position, list) else ["X", "Y"]
    term, place = "reach", f"position: [{', '.join(numbers)}]"
    if "time" in given:
        term, place = "track", f"keys: [[{', '.join([str(given['time']), *numbers])}]]"
    objective = f"objective: {{there: {{{term}: {{body: {given.get('body', 'BODY')}, {place}}}}}}}"
    return (
        f"a wanted place is an objective, not data: remove `data` and write `{objective}`; `cqrun sysid` makes it small"
    )


class Tie(Spec):
    """How another number follows an unknown: factor * value + offset."""

    factor: float = Field(description="Its change for one of the unknown", default=1.0)
    offset: float = Field(description="Its value where the unknown is 0, in its own unit", default=0.0)

    @model_validator(mode="after")
    def _follows(self) -> Self:
        if self.factor == 0:
            raise complaint("Tie", [finding("must not be 0: nothing would follow; set the number itself", ("factor",))])
        return self


def _ties(value: Any) -> Any:
    """Return a list of paths as paths that are equal to the unknown."""
    if isinstance(value, list) and all(isinstance(path, str) for path in value):
        return {path: {} for path in value}
    return value


class Unknown(Spec):
    """A leaf of the scene that an optimizer may change."""

    bounds: Interval = Field(description="Least and greatest value, in the leaf's unit")
    scale: Literal["linear", "log"] = Field(description="What the optimizer sees", default="linear")
    per: Literal["body", "group", "particle", "field"] = Field(
        description="One value a body, a group or a particle, or a smooth field over the body", default="body"
    )
    resolution: int | None = Field(
        description="Of a field: cells of its splines along the body's longest edge, 4 if absent", ge=1, le=64,
        default=None,
    )  # fmt: skip
    mirror: Literal["x", "y", "z"] | None = Field(
        description="Axis across whose middle the body is its own mirror image, and so are the values: left = right",
        default=None,
    )
    also: Annotated[dict[str, Tie], BeforeValidator(_ties)] = Field(
        description="Key paths that change with it: a list of those that are equal, or path -> {factor, offset}",
        default_factory=dict,
    )
    initial: float | None = Field(description="Start; the scene's own value if absent", default=None)
    regulariser: float = Field(
        description="Weight in the loss of the mean squared way from the start, bounds being 1 apart", ge=0, default=0.0
    )

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
