"""What every actuator is: something in a body that activations drive, within limits.

An activation is one number, held through a control step; a stress or a force is proportional to it and to the
actuator's strength (a modulus, a pressure, a stiffness: the field that `scale` names). Stress actuators are terms of
the Kirchhoff stress (`materials/term.py`) whose parameters the activations fill; the others exert forces on particles,
which depend on the state (`forces/force.py`) or are steady through a control step (`forces/steady.py`).
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from cqrun.explain import Loc
from cqrun.forces.force import Inside
from cqrun.plugin.choice import Choice, Chosen
from cqrun.plugin.contract import Array, Plugin, quantity
from cqrun.plugin.reference import BodyName, GroupName


class Actuator(Plugin):
    """Something in a body that activations drive.

    An actuator may have several parts, each with an activation of its own.
    """

    body: BodyName = Field(description="Body it lies in")
    rate: float | None = quantity(
        "1/s", "Greatest change of the activation in a second, at first from where it does nothing; any if absent",
        gt=0, default=None,
    )  # fmt: skip

    scale: ClassVar[str] = ""
    """The differentiable field that an activation is multiplied by."""

    neutral: ClassVar[float] = 0.0
    """The activation that does nothing: of a part that nothing drives."""

    kernel: ClassVar[type]
    """The class of the kernels' view: of a term of the stress, or of a force."""

    @property
    def limits(self) -> tuple[float, float]:
        """The least and greatest activation."""
        return -1.0, 1.0

    def parts(self) -> tuple[str, ...]:
        """Return the names of its parts; one without a name if there is but one."""
        return ("",)

    @abstractmethod
    def particles(self, part: str, x: Array, inside: Inside) -> Array:
        """Return the particles of a part.

        Args:
            part: one of `parts`.
            x: all particles at rest (N, D) [m].
            inside: finds the particles of a body and region.
        """

    @abstractmethod
    def constants(self, x: Array) -> Array:
        """Return what else a kernel needs of a part, as numbers; of a stress actuator the rows of its direction.

        Args:
            x: the part's particles at rest (n, D) [m].
        """

    def rest_length(self, x: Array) -> float:
        """Return the length at rest [m] of a part whose particles at rest are x (n, D) [m]; 0 where it has none."""
        return 0.0

    def rest_length_vjp(self, x: Array, bar: float) -> Array:
        """Return the cotangent of x (n, D)."""
        return np.zeros(x.shape)

    def problem(self, x: Array, dx: float) -> str | None:
        """Return what is wrong with a part whose particles at rest are x (n, D) [m], in cells of dx [m], or None."""
        return None

    def greatest_acceleration(self, strength: float) -> float:
        """Return what a part accelerates its particles by, whatever their mass [m/s^2]."""
        return 0.0

    def wave_modulus(self) -> float:
        """Return what one unit of activation and strength adds to the stiffness of a pressure wave."""
        return 0.0

    def stiffness_at_nodes(self, strength: float) -> float:
        """Return the stiffness that a part adds to nodes of the grid that its particles touch [N/m]."""
        return 0.0


class RegionActuator(Actuator):
    """An actuator that acts on the particles of a region, or of several groups apart."""

    region: Annotated[Chosen[Plugin], Choice("region")] | None = Field(
        description="Where, at rest; the whole body if absent", default=None
    )
    each: list[GroupName] | None = Field(
        description="Groups of the body, each with an activation of its own", min_length=1, default=None
    )

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions, or itself."""
        found = super().dim_problems(dim) + [
            (("each", k), f"'{group}' is named twice: a group has one activation")
            for k, group in enumerate(self.each or [])
            if group in (self.each or [])[:k]
        ]
        if self.region is not None and self.each is not None:
            told = (
                "stands beside `each`, which says where: give one of the two, or name a region of the scene in `each`"
            )
            found.append((("region",), told))
        return found

    def parts(self) -> tuple[str, ...]:
        """Return the names of its parts; one without a name if there is but one."""
        return tuple(self.each) if self.each is not None else ("",)

    def particles(self, part: str, x: Array, inside: Inside) -> Array:
        """Return the particles of a part; see `Actuator.particles`."""
        return inside(self.body, part if self.each is not None else self.region)


class DirectedStress(RegionActuator):
    """A stress F S F^T with S along an axis of the body at rest, or isotropic."""

    weight: float = quantity(
        "1", "Share of its strength that each particle has; as an unknown `per: field`, where it lies",
        differentiable=True, ge=0, default=1.0,
    )  # fmt: skip
    axis: list[float] | Literal["isotropic"] = Field(description="Direction at rest, made unit; or isotropic")

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        found = super().dim_problems(dim)
        if isinstance(self.axis, list) and len(self.axis) != dim:
            found.append((("axis",), f"must have {dim} entries in this {dim}D world, has {len(self.axis)}"))
        elif isinstance(self.axis, list) and not np.any(self.axis):
            found.append((("axis",), "must not be zero; give a direction, or isotropic"))
        return found

    def wave_modulus(self) -> float:
        """Return what one unit of activation and strength adds to the stiffness of a pressure wave."""
        return 1.0

    def direction(self, dim: int) -> Array:
        """Return n n^T of the unit axis n, or I (D, D)."""
        if self.axis == "isotropic":
            return np.eye(dim)
        n = np.array(self.axis) / np.linalg.norm(self.axis)
        return np.outer(n, n)


def held_to(wanted: Array, previous: Array, low: Array, high: Array, change: Array) -> tuple[Array, Array, Array]:
    """Return activations within their limits, and within `change` of the previous ones; and the derivatives.

    At a limit the derivative by what is wanted is 1 towards the inside, so that an optimizer finds its way back.

    Args:
        wanted: activations asked for (A,).
        previous: those of the control step before (A,), at the first those of actuators that do nothing.
        low, high: limits (A,).
        change: greatest change in a control step (A,), infinite where there is none.

    Returns:
        The activations, and their derivatives by `wanted` and by `previous`, each (A,) of 0 and 1.
    """
    clipped = np.clip(wanted, low, high)
    by_wanted = ((wanted >= low) & (wanted <= high)).astype(float)
    given = np.clip(clipped, previous - change, previous + change)
    late = given != clipped
    return given, np.where(late, 0.0, by_wanted), late.astype(float)
