"""Section `rigid`: bodies that do not deform. They stay, follow a path or move freely, and soft bodies touch them."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator
from pydantic_core import InitErrorDetails

from cqrun.explain import Loc, complaint, finding
from cqrun.geometry.shape import ChosenShape
from cqrun.plugin.contract import Spec, quantity, vector
from cqrun.plugin.reference import FilledIn
from cqrun.scene.fields import turning_problems

FREE_ONLY = ("velocity", "spin", "force", "torque")
"""Fields that have no effect on a body that does not move freely."""


class Waypoint(Spec):
    """Where a rigid body is at one time, from its place at the start."""

    time: float = quantity("s", "When it is there", ge=0)
    displacement: Annotated[list[float], FilledIn("zero vector")] = vector(
        "m", "Displacement of its centre; zero if absent", differentiable=True
    )
    rotation: Annotated[list[float], FilledIn("zero spin")] = quantity(
        "rad", "Rotation about its centre: an angle in 2D, a rotation vector in 3D; zero if absent",
        differentiable=True, min_length=1, max_length=3,
    )  # fmt: skip

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        return [*super().dim_problems(dim), *turning_problems(self, ("rotation",), dim)]


class RigidBody(Spec):
    """A body that does not deform. Soft bodies of the reference frame touch it; rigid bodies do not feel each other.

    In 2D, masses and forces are those of a depth of 1 m.
    """

    shape: ChosenShape = Field(description="Its shape, at the start; the distance from its surface must be known")
    motion: Literal["fixed", "free"] = Field(
        description="`free`: gravity, forces and contact move it; `fixed`: it stays, or follows its path",
        default="fixed",
    )
    path: list[Waypoint] | None = Field(
        description="Waypoints with increasing times. Displacement and rotation change at constant rates between them, "
        "and stay after the last. A path that begins later than 0 comes from the place of the shape at time 0",
        min_length=1, default=None,
    )  # fmt: skip
    density: float | None = quantity("kg/m^3", "Density, of a free body", differentiable=True, gt=0, default=None)
    mass: float | None = quantity("kg", "Mass, of a free body; in place of density", differentiable=True, gt=0,
                                  default=None)  # fmt: skip
    inertia: list[Annotated[float, Field(gt=0)]] | None = quantity(
        "kg m^2", "Moments of inertia about the centre, in 3D about axes along x, y and z at the start; those of the "
        "shape if absent", min_length=1, max_length=3, default=None,
    )  # fmt: skip
    center: list[float] | None = vector(
        "m", "Centre of mass, about which it turns, at the start; the centroid of the shape if absent", default=None
    )
    friction: float = quantity("1", "Coulomb friction coefficient", differentiable=True, ge=0, default=0.0)
    dashpot: float = quantity(
        "1", "Damping of contact along the normal, as a part of the soft material's wave impedance", ge=0, default=0.1
    )
    offset: Annotated[list[float], FilledIn("zero vector")] = vector(
        "m", "Displacement of the shape at the start; zero if absent", differentiable=True
    )
    velocity: Annotated[list[float], FilledIn("zero vector")] = vector(
        "m/s", "Velocity of the centre at the start, of a free body; zero if absent", differentiable=True
    )
    spin: Annotated[list[float], FilledIn("zero spin")] = quantity(
        "rad/s", "Angular velocity at the start, of a free body (2D: one entry); zero if absent",
        differentiable=True, min_length=1, max_length=3,
    )  # fmt: skip
    force: Annotated[list[float], FilledIn("zero vector")] = vector(
        "N", "Constant force at the centre, of a free body; zero if absent", differentiable=True
    )
    torque: Annotated[list[float], FilledIn("zero spin")] = quantity(
        "N m", "Constant torque, of a free body (2D: one entry); zero if absent",
        differentiable=True, min_length=1, max_length=3,
    )  # fmt: skip

    @property
    def free(self) -> bool:
        """Whether forces move it."""
        return self.motion == "free"

    @property
    def waypoints(self) -> list[Waypoint]:
        """The waypoints of its path; none if it has no path."""
        return self.path or []

    @model_validator(mode="after")
    def _has_what_it_needs(self) -> Self:
        if problems := [*self._mass_problems(), *self._path_problems()]:
            raise complaint("RigidBody", problems)
        return self

    def _path_problems(self) -> Iterator[InitErrorDetails]:
        times = [point.time for point in self.waypoints]
        if self.free and times:
            yield finding("moves freely, so it cannot follow a path: remove one of the two", ("path",))
        for k, (before, after) in enumerate(itertools.pairwise(times), 1):
            if after == before:
                message = f"a path cannot jump: it has two waypoints at {after:g} s; give the move some time"
                yield finding(message, ("path", k, "time"))
            elif after < before:
                yield finding(f"times must increase along a path, and {before:g} s is before", ("path", k, "time"))

    def _mass_problems(self) -> list[InitErrorDetails]:
        if self.density is not None and self.mass is not None:
            return [finding("has a density and a mass: give one of them", involves=("density", "mass"))]
        if self.free:
            if self.density is None and self.mass is None:
                return [finding("moves freely, so it needs a `density` or a `mass`", ("motion",))]
            return []
        useless = [name for name in FREE_ONLY if any(getattr(self, name))]
        message = "has no effect on a body that does not move freely: set `motion: free`, or remove it"
        return [finding(message, (name,), involves=("motion",)) for name in useless]

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        return [*super().dim_problems(dim), *turning_problems(self, ("spin", "torque", "inertia"), dim)]
