"""Sections `world`, `time` and `trajectory`: the box and its grid, the duration and its steps, and what is kept."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from cqrun.explain import complaint, finding
from cqrun.plugin.contract import Spec, quantity, vector
from cqrun.plugin.reference import FilledIn
from cqrun.scene.fields import Substeps

ON_CONTROL_STEP = 1e-9
"""Largest relative difference between a duration and a whole number of control steps."""


class BodyContact(Spec):
    """How bodies of the reference frame meet each other; without it they slide without friction."""

    coefficient: float = quantity(
        "1", "Coulomb friction coefficient between bodies", differentiable=True, ge=0, default=0.0
    )
    dashpot: float = quantity(
        "1", "Damping of contact along the normal, as a part of the materials' wave impedance", ge=0, default=0.1
    )


class World(Spec):
    """The box that contains everything, with its lower corner at the origin, and its grid."""

    size: list[Annotated[float, Field(gt=0)]] = vector("m", "Edge lengths; their number is the dimension of the world")
    dx: float = quantity("m", "Edge of a grid cell", gt=0)
    frame: Literal["updated", "reference"] = Field(
        description="Frame of the engine: `reference` follows the rest shape, without numerical damping or drift, for "
        "elastic bodies that stay whole; `updated` is that of the papers, in which bodies may tear and merge",
        default="reference",
    )
    volume: Literal["auto", "local", "averaged"] = Field(
        description="Volume changes that a material resists: `local`, those of each particle; `averaged`, means over "
        "the corners of cells, with which bodies that keep their volume do not lock; `auto`, averaged in the reference "
        "frame if a Poisson's ratio may reach 0.49",
        default="auto",
    )
    contact: BodyContact | None = Field(description="How bodies meet each other in the reference frame", default=None)
    gravity: Annotated[list[float], FilledIn("zero vector")] = vector(
        "m/s^2", "Gravity; zero if absent", differentiable=True
    )


class TrajectoryFile(Spec):
    """What a trajectory holds beside positions, velocities and volume ratios."""

    fields: list[Literal["strain", "stress"]] = Field(
        description="More fields of every particle: `strain`, the Green strain; `stress`, the Cauchy stress of the "
        "material [Pa]",
        default_factory=list,
    )
    frames: int = Field(
        description="Largest number of frames after the first; they are spread evenly over the control steps", ge=1,
        le=1_000_000, default=300,
    )  # fmt: skip


class Time(Spec):
    """The duration of the run, and its steps."""

    duration: float = quantity("s", "Duration of the run, a multiple of the control step", gt=0)
    control_step: float = quantity("s", "Time between two frames, and between two values of a signal", gt=0)
    substeps: Substeps = Field(
        description="Engine steps per control step, or auto: as many as all values within the unknowns' bounds need",
        default="auto",
    )

    stretch: float | None = Field(
        description="Largest stretch for which auto makes substeps, in place of that of clamps that pull a body; "
        "matters from 1.5 on",
        gt=1, default=None, exclude_if=lambda value: value is None,
    )  # fmt: skip

    @property
    def control_steps(self) -> int:
        """The number of control steps in the run."""
        return round(self.duration / self.control_step)

    @model_validator(mode="after")
    def _whole_steps(self) -> Self:
        step, count = self.control_step, max(1, self.control_steps)
        if abs(count * step - self.duration) > ON_CONTROL_STEP * self.duration:
            message = (
                f"{self.duration:.10g} s is not a multiple of the control step {step:.10g} s; "
                f"the nearest is {count * step:.10g} s"
            )
            raise complaint("Time", [finding(message, ("duration",), involves=("control_step",))])
        return self
