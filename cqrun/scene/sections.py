"""The sections of a scene: everything that a user may write, with units, ranges and defaults."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from cqrun.geometry.region import ChosenRegion
from cqrun.plugin.choice import Choice, Chosen
from cqrun.plugin.contract import Plugin, Spec
from cqrun.scene.activation import Activation
from cqrun.scene.body import Body
from cqrun.scene.constraint import Constraint
from cqrun.scene.control import Episodes, Goal
from cqrun.scene.data import Data, Recording, Synthetic, Unknown
from cqrun.scene.fields import Memory, Name, Seed
from cqrun.scene.load_path import PathValues
from cqrun.scene.rigid import RigidBody
from cqrun.scene.world_and_time import Time, TrajectoryFile, World

if TYPE_CHECKING:
    from cqrun.measurements.measurement import Measurement

JobName = Literal["simulate", "rest", "sysid", "control", "codesign", "gradcheck"]
"""The jobs of a scene; jobs/table.py defines what each does."""


class Sections(Spec):
    """The sections of a scene, each validated alone."""

    cqrun: Literal[1] = Field(description="Version of the scene format")
    title: str = Field(description="One line that describes the scene", default="")
    job: JobName | None = Field(description="Command that the scene is made for", default=None)
    plugins: list[str] = Field(
        description="Python files with your own plug-ins, beside the scene; run only with --allow-plugins",
        default_factory=list,
    )
    world: World = Field(description="Box and grid")
    precision: Literal["float64", "float32"] = Field(description="Precision of the engine", default="float64")
    memory: Memory = Field(
        description="Memory for the states that gradients keep: bytes, or with a unit, such as 8GiB", default=2 * 2**30
    )
    seed: Seed = Field(description="Seed of every part that gives no seed itself", default=0)
    bodies: dict[Name, Body] = Field(description="Name -> body", min_length=1)
    regions: dict[Name, ChosenRegion] = Field(
        description="Name -> region of the world at the start; use the name wherever a region is needed",
        default_factory=dict,
    )
    boundaries: dict[Name, Annotated[Chosen[Plugin], Choice("boundary")]] = Field(
        description="Name -> boundary; if several hold a node, they act in this order", default_factory=dict
    )
    rigid: dict[Name, RigidBody] = Field(
        description="Name -> rigid body: it stays, follows a path or moves freely, and soft bodies touch it",
        default_factory=dict, exclude_if=lambda rigid: not rigid,
    )  # fmt: skip
    loads: dict[Name, Annotated[Chosen[Plugin], Choice("load")]] = Field(
        description="Name -> load", default_factory=dict
    )
    forces: dict[Name, Annotated[Chosen[Plugin], Choice("force")]] = Field(
        description="Name -> force that depends on the motion", default_factory=dict,
        exclude_if=lambda forces: not forces,  # so that scenes without any keep the names of their runs
    )  # fmt: skip
    actuators: dict[Name, Annotated[Chosen[Plugin], Choice("actuator")]] = Field(
        description="Name -> actuator", default_factory=dict
    )
    activation: Activation | None = Field(description="Open-loop signals", default=None)
    path: dict[str, PathValues] = Field(
        description="Key path, or activation.NAME -> values that `cqrun rest` goes through", default_factory=dict,
        exclude_if=lambda path: not path,
    )  # fmt: skip
    measure: dict[Name, Annotated[Chosen[Plugin], Choice("measure")]] = Field(
        description="Name -> measured quantity over time: a table, a term, a constraint, or what a controller sees",
        default_factory=dict, exclude_if=lambda measure: not measure,
    )  # fmt: skip
    observers: dict[Name, Annotated[Chosen[Plugin], Choice("observer")]] = Field(
        description="Name -> observer: what a controller sees", default_factory=dict
    )
    controller: Annotated[Chosen[Plugin], Choice("controller")] | None = Field(
        description="What drives the actuators; `cqrun control` learns it", default=None
    )
    goals: dict[Name, Goal] = Field(description="Name -> goal of an episode", default_factory=dict)
    episodes: Episodes = Field(description="Rollouts in an iteration", default_factory=Episodes)
    objective: dict[Name, Annotated[Chosen[Plugin], Choice("objective")]] = Field(
        description="Name -> term of the objective, which is minimised", default_factory=dict
    )
    constraints: dict[Name, Constraint] = Field(
        description="Name -> constraint, for an optimizer that handles constraints", default_factory=dict
    )
    start: Literal["rest_shape", "equilibrium"] = Field(
        description="Where a motion starts: in the rest shape, or at rest under the first loads and activations",
        default="rest_shape", exclude_if=lambda start: start == "rest_shape",
    )  # fmt: skip
    trajectory: TrajectoryFile = Field(
        description="Fields and frames of trajectory.h5", default_factory=TrajectoryFile,
        exclude_if=lambda trajectory: trajectory == TrajectoryFile(),
    )  # fmt: skip
    time: Time = Field(description="Duration and steps")
    data: Data | None = Field(description="Data that the run is fitted to", default=None)
    unknowns: dict[str, Unknown] = Field(
        description="Key path -> unknown, a value that may change", default_factory=dict
    )
    optimizer: Annotated[Chosen[Plugin], Choice("optimizer")] | None = Field(
        description="Method that finds the unknowns", default=None
    )

    @property
    def bodies_meet(self) -> bool:
        """Whether bodies touch each other with their surfaces: several do, in the reference frame."""
        return self.world.frame == "reference" and len(self.bodies) > 1

    @property
    def dim(self) -> int:
        """2 or 3: the dimension of the world."""
        return len(self.world.size)

    @property
    def recordings(self) -> dict[str, Recording]:
        """The recordings that the scene is fitted to, by name."""
        return (self.data.recordings if self.data is not None else None) or {}

    @property
    def predicts_only(self) -> bool:
        """Whether all data are held out, so that nothing is fitted."""
        return bool(self.recordings) and all(recording.holdout for recording in self.recordings.values())

    @property
    def synthetic(self) -> Synthetic | None:
        """The synthetic data of the scene, if any."""
        return self.data.synthetic if self.data is not None else None

    @property
    def measured(self) -> Measurement | None:
        """A measurement whose unit all recordings have; None without data, or if the units differ."""
        found = [] if self.data is None else self.data.measurements
        return found[0] if len({m.unit for m in found}) == 1 else None

    @property
    def loss_unit(self) -> str:
        """SI unit of a fit's loss, such as m^2; empty if it has none, or if the unit is not known."""
        return "" if self.measured is None or self.measured.unit == "1" else f"{self.measured.unit}^2"

    @property
    def sequences(self) -> int:
        """The number of random activation sequences in synthetic data; 1 if the activation is not random."""
        random = self.activation.random if self.activation is not None else None
        return 1 if random is None else random.sequences
