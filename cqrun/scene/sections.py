"""The sections of a scene: what a user may write, with units, ranges and defaults."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from cqrun.geometry.region import ChosenRegion
from cqrun.plugin.choice import Choice, Chosen
from cqrun.plugin.contract import Plugin, Spec
from cqrun.scene.activation import Activation
from cqrun.scene.body import Body
from cqrun.scene.constraint import Constraint
from cqrun.scene.control import Episodes, Goal
from cqrun.scene.data import Data, Recording, Synthetic, Target, Unknown
from cqrun.scene.fields import Memory, Name, Seed
from cqrun.scene.world_and_time import Time, World

JobName = Literal["simulate", "sysid", "control", "codesign", "gradcheck"]
"""What can be run of a scene; jobs/table.py has what each does."""


class Sections(Spec):
    """The sections of a scene, each valid by itself."""

    cqrun: Literal[1] = Field(description="Version of the scene format")
    title: str = Field(description="One line about the scene", default="")
    job: JobName | None = Field(description="Command that the scene is made for", default=None)
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
