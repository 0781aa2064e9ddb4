"""Scene version 1: what a user may write, with units, ranges and defaults."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, PrivateAttr, model_validator

from cqrun.choice import Choice, Chosen
from cqrun.contract import Plugin, Spec, quantity, vector
from cqrun.explain import Loc, complaint, finding
from cqrun.geometry.file_shape import FileShape
from cqrun.geometry.lattice import Lattice
from cqrun.geometry.place import Place
from cqrun.geometry.region import ChosenRegion
from cqrun.geometry.sampling import ChosenSampling
from cqrun.geometry.shape import ChosenShape, Shape
from cqrun.geometry.transformed import Transformed
from cqrun.geometry.union import Union
from cqrun.scene.constraint import Constraint
from cqrun.scene.control import Episodes, Goal
from cqrun.scene.data import Data, Recording, Synthetic, Target, Unknown, exactly_one
from cqrun.scene.defaults import with_defaults
from cqrun.scene.fields import Memory, Name, Seed, Substeps
from cqrun.scene.material import Material, OtherMaterial
from cqrun.scene.origin import Origin
from cqrun.scene.references import findings_between
from cqrun.scene.walk import parts

ON_CONTROL_STEP = 1e-9
"""How far, relative, a duration may be from a whole number of control steps."""


class World(Spec):
    """The box that holds everything, lower corner at the origin, and its grid."""

    size: list[Annotated[float, Field(gt=0)]] = vector("m", "Edge lengths; their number is the dimension")
    dx: float = quantity("m", "Edge of a grid cell", gt=0)
    gravity: list[float] = vector("m/s^2", "Gravity; zero if absent", differentiable=True)


class Body(Spec):
    """One elastic body: a shape, or named parts, filled with particles of one material."""

    shape: ChosenShape | None = Field(description="Where the body is at the start; or give parts", default=None)
    parts: dict[Name, ChosenShape] | None = Field(
        description="Name -> shape; each is filled on its own, and is a group", min_length=1, default=None
    )
    place: Place | None = Field(
        description="Where the coordinates of shape, parts and groups lie in the world; they are the world's if absent",
        default=None,
    )
    particles_per_cell: float | None = quantity("1", "Particles in a cell: spacing = dx / n^(1/D)", gt=0, default=None)
    spacing: float | None = quantity("m", "Distance between particles", gt=0, default=None)
    sampling: ChosenSampling = Field(
        description="How particles are placed", default_factory=lambda: Chosen("lattice", Lattice())
    )
    velocity: list[float] = vector("m/s", "Velocity at the start; zero if absent", differentiable=True)
    spin: list[float] = quantity(
        "rad/s",
        "Rate of rotation about the centroid at the start (2D: one entry); zero if absent",
        differentiable=True, min_length=1, max_length=3,
    )  # fmt: skip
    unit_mass: bool = Field(description="Every particle has mass = density and volume 1", default=False)
    groups: dict[Name, ChosenRegion] = Field(description="Named regions of the body", default_factory=dict)
    material: Material = Field(description="What it is made of")
    material_of: dict[Name, OtherMaterial] = Field(
        description="Name of a group or region -> what is different there; a later one wins", default_factory=dict
    )

    @model_validator(mode="after")
    def _one_of_each(self) -> Self:
        exactly_one(self, ("shape", "parts"))
        if self.sampling.value.needs_spacing:
            exactly_one(self, ("particles_per_cell", "spacing"))
        elif self.particles_per_cell is not None or self.spacing is not None:
            name = "spacing" if self.particles_per_cell is None else "particles_per_cell"
            message = f"has no meaning with {self.sampling.name} sampling, which has a count: remove it"
            raise complaint("Body", [finding(message, (name,), involves=("sampling",))])
        return self

    @model_validator(mode="after")
    def _one_law(self) -> Self:
        found = [
            finding(message, ("material_of", name, *place))
            for name, other in self.material_of.items()
            for place, message in other.problems(self.material)
        ]
        if found:
            raise complaint("Body", found)
        return self

    @property
    def pieces(self) -> dict[str, Shape]:
        """The shapes that are filled on their own, in the body's coordinates, by their key path inside the body."""
        if self.shape is not None:
            return {"shape": self.shape.value}
        return {f"parts.{name}": chosen.value for name, chosen in (self.parts or {}).items()}

    @property
    def group_names(self) -> tuple[str, ...]:
        """The names of all groups, in the order in which values `per: group` are given."""
        return (*(self.parts or {}), *self.colours, *self.groups)

    @property
    def colours(self) -> tuple[str, ...]:
        """The names of the colours of its images, each a group."""
        return tuple(dict.fromkeys(name for piece in self.pieces.values() for name in piece.colour_names))

    def whole(self) -> Shape:
        """Return the body as one shape in the world."""
        whole = self.shape or Chosen("union", Union(shapes=list((self.parts or {}).values())))
        return whole.value if self.place is None else Transformed(shape=whole, **dict(self.place))

    def particle_spacing(self, dx: float) -> float | None:
        """Return the distance between particles [m] on a grid of edge dx [m]; None with a count of them."""
        if self.particles_per_cell is not None:
            return dx / self.particles_per_cell ** (1 / len(self.velocity))
        return self.spacing

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        found, wanted = super().dim_problems(dim), 1 if dim == 2 else 3
        if len(self.spin) != wanted:
            message = f"must have {wanted} entries in this {dim}D world, has {len(self.spin)}"
            found.append((("spin",), message))
        return found


class RandomActivation(Spec):
    """Sequences of random knots, for synthetic data."""

    sequences: int = Field(description="How many sequences", ge=1)
    knots: int = Field(description="Knots in each, spread evenly over the run", ge=1)
    low: float = quantity("1", "Least activation", default=0.0)
    high: float = quantity("1", "Greatest activation", default=1.0)
    seed: Seed = Field(description="Seed of the knots", default=0)

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.low < self.high:
            message = f"must be greater than low, is {self.high:g}"
            raise complaint("RandomActivation", [finding(message, ("high",), involves=("low",))])
        return self


Knots = Annotated[list[float], Field(min_length=1)]


class Activation(Spec):
    """Open-loop signals of the actuators: given knots, or random ones."""

    signals: dict[Name, Knots] | None = quantity(
        "1", "Actuator -> knots, spread evenly over time", differentiable=True, default=None
    )
    random: RandomActivation | None = Field(description="Random sequences", default=None)
    interpolate: Literal["hold", "linear"] = Field(description="Between knots", default="hold")
    over: float | None = quantity(
        "s",
        "Time that the knots are spread over, and after it the last; the run's duration if absent",
        gt=0,
        default=None,
    )

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        exactly_one(self, ("signals", "random"))
        return self


class Time(Spec):
    """How long, and in which steps."""

    duration: float = quantity("s", "Length of the run, a multiple of the control step", gt=0)
    control_step: float = quantity("s", "Time between two frames, and two values of a signal", gt=0)
    substeps: Substeps = Field(description="Steps of the engine in a control step, or auto", default="auto")

    @property
    def control_steps(self) -> int:
        """How many control steps the run has."""
        return round(self.duration / self.control_step)

    @model_validator(mode="after")
    def _whole_steps(self) -> Self:
        step, count = self.control_step, max(1, self.control_steps)
        if abs(count * step - self.duration) > ON_CONTROL_STEP * self.duration:
            message = (
                f"{self.duration:.10g} s is no multiple of the control step {step:.10g} s; "
                f"the nearest is {count * step:.10g} s"
            )
            raise complaint("Time", [finding(message, ("duration",), involves=("control_step",))])
        return self


class Scene(Spec):
    """A world, its bodies, what acts on them, for how long, and what a job looks for."""

    cqrun: Literal[1] = Field(description="Version of the scene format")
    title: str = Field(description="One line about the scene", default="")
    job: Literal["simulate", "sysid", "control", "codesign", "gradcheck"] | None = Field(
        description="Command that the scene is made for", default=None
    )
    plugins: list[str] = Field(
        description="Python files with plug-ins of your own, beside the scene; run only with --allow-plugins",
        default_factory=list,
    )
    world: World = Field(description="Box and grid")
    precision: Literal["float64", "float32"] = Field(description="Of the engine", default="float64")
    memory: Memory = Field(
        description="Budget for states kept for gradients: bytes, or with a unit, such as 8GiB", default=2 * 2**30
    )
    seed: Seed = Field(description="Seed of whatever names none of its own", default=0)
    bodies: dict[Name, Body] = Field(description="Name -> body", min_length=1)
    regions: dict[Name, ChosenRegion] = Field(
        description="Name -> region of the world at the start; wherever a region is asked for, its name will do",
        default_factory=dict,
    )
    boundaries: dict[Name, Annotated[Chosen[Plugin], Choice("boundary")]] = Field(
        description="Name -> boundary; where several hold a node they act in this order", default_factory=dict
    )
    loads: dict[Name, Annotated[Chosen[Plugin], Choice("load")]] = Field(
        description="Name -> load", default_factory=dict
    )
    actuators: dict[Name, Annotated[Chosen[Plugin], Choice("actuator")]] = Field(
        description="Name -> actuator", default_factory=dict
    )
    activation: Activation | None = Field(description="Open-loop signals", default=None)
    observers: dict[Name, Annotated[Chosen[Plugin], Choice("observer")]] = Field(
        description="Name -> what a controller sees", default_factory=dict
    )
    controller: Annotated[Chosen[Plugin], Choice("controller")] | None = Field(
        description="What drives the actuators, learned by `cqrun control`", default=None
    )
    goals: dict[Name, Goal] = Field(description="Name -> what an episode is about", default_factory=dict)
    episodes: Episodes = Field(description="Rollouts of an iteration", default_factory=Episodes)
    objective: dict[Name, Annotated[Chosen[Plugin], Choice("objective")]] = Field(
        description="Name -> term of what is made small", default_factory=dict
    )
    constraints: dict[Name, Constraint] = Field(
        description="Name -> what must hold, for an optimizer that honours constraints", default_factory=dict
    )
    time: Time = Field(description="Duration and steps")
    data: Data | None = Field(description="What the run is fitted to", default=None)
    unknowns: dict[str, Unknown] = Field(description="Key path -> what may change", default_factory=dict)
    optimizer: Annotated[Chosen[Plugin], Choice("optimizer")] | None = Field(
        description="How unknowns are found", default=None
    )

    _origin: Origin = PrivateAttr(default_factory=Origin)

    @property
    def dim(self) -> int:
        """2 or 3: the dimension of the world."""
        return len(self.world.size)

    @property
    def recordings(self) -> dict[str, Recording]:
        """The measured motions it is fitted to, by name."""
        return (self.data.recordings if self.data is not None else None) or {}

    @property
    def synthetic(self) -> Synthetic | None:
        """The data that it makes itself, if it does."""
        return self.data.synthetic if self.data is not None else None

    @property
    def target(self) -> Target | None:
        """Where a body's centroid shall be, if it says so."""
        return self.data.target if self.data is not None else None

    @property
    def sequences(self) -> int:
        """How many random sequences of activations synthetic data has; 1 where they are not random."""
        random = self.activation.random if self.activation is not None else None
        return 1 if random is None else random.sequences

    def came_from(self, origin: Origin) -> None:
        """Take up where the scene came from; files that its shapes name start from there."""
        self._origin = origin
        for _, part in parts(self):
            if isinstance(part, FileShape):
                part.found_in(self.resolve_path(""))

    @property
    def source(self) -> Path | None:
        """The file the scene was read from; files it names are relative to it."""
        return self._origin.source

    @property
    def text(self) -> str:
        """The text the scene was read from; empty for a scene made of data."""
        return self._origin.text

    def where(self, path: str) -> str:
        """Return `file:line:column` of a key path, or the override that set it."""
        return self._origin.where_path(path)

    def resolve_path(self, file: str) -> Path:
        """Return the path of a file that the scene names."""
        return self._origin.path_of(file)

    def plugin_paths(self) -> dict[str, Path]:
        """Return the paths of the scene's plug-in files, by the names it uses."""
        return dict(zip(self.plugins, self._origin.plugin_paths(self.plugins), strict=True))

    def with_plugin(self, key: str, plugin: Plugin) -> Scene:
        """Return this scene with another optimizer or controller."""
        changed = self.model_copy(update={key: Chosen(plugin.name, plugin)})
        changed._origin = self._origin
        return changed

    @model_validator(mode="before")
    @classmethod
    def _fill_in(cls, data: Any) -> Any:
        return with_defaults(data)

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        findings = findings_between(self)
        if findings:
            raise complaint("Scene", findings)
        return self
