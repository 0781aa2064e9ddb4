"""Actuators: parts of a body that activations drive, within limits.

An activation is one number for a control step. A stress or a force is proportional to it and to the actuator's strength
(a modulus, a pressure, a stiffness: the field that `scale` names). Stress actuators are terms of the Kirchhoff stress
(`materials/term.py`) whose parameters the activations fill. The others apply forces to particles, which depend on the
state (`forces/force.py`) or are constant in a control step (`forces/steady.py`).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from cqrun.explain import Loc
from cqrun.forces.force import Inside, Riding, Skin
from cqrun.plugin.choice import Choice, Chosen
from cqrun.plugin.contract import Array, Plugin, quantity
from cqrun.plugin.reference import BodyName, GroupName


class Actuator(Plugin):
    """A device in a body that activations drive; it may have several parts, each with its own activation."""

    body: BodyName = Field(description="Body that contains it")
    rate: float | None = quantity(
        "1/s", "Largest change of the activation per second, at first from its neutral value; unlimited if absent",
        gt=0, default=None,
    )  # fmt: skip

    scale: ClassVar[str] = ""
    """The differentiable field that an activation is multiplied by."""

    neutral: ClassVar[float] = 0.0
    """The activation that has no effect; a part that nothing drives has it."""

    kernel: ClassVar[type]
    """The class of the kernels' view: of a term of the stress, or of a force."""

    frame: ClassVar[str | None] = None
    """The only frame in which it acts; None for both."""

    per: ClassVar[Literal["volume", "mass"]] = "volume"
    """What the potential of a particle is multiplied by, for an actuator that has one (`potential`)."""

    @property
    def limits(self) -> tuple[float, float]:
        """The smallest and largest activation."""
        return -1.0, 1.0

    def parts(self) -> tuple[str, ...]:
        """Return the names of its parts; a single part has an empty name."""
        return ("",)

    @abstractmethod
    def particles(self, part: str, x: Array, inside: Inside) -> Array:
        """Return the particles of a part.

        Args:
            part: one of `parts`.
            x: all particles at rest (N, D) [m].
            inside: finds the particles of a body and region.
        """

    def riding(self, part: str, skin: Callable[[], Skin]) -> Riding | None:
        """Return the points that a part acts on, in place of particles; None if it acts on particles.

        Args:
            part: one of `parts`.
            skin: returns the surface of its body.

        Raises:
            UsageError: there are no such points.
        """
        return None

    @abstractmethod
    def constants(self, x: Array) -> Array:
        """Return a part's other numbers for its kernel, for its particles at rest x (n, D) [m].

        A stress actuator returns the rows of its direction.
        """

    def rest_length(self, x: Array) -> float:
        """Return the length at rest [m] of a part whose particles at rest are x (n, D) [m]; 0 if it has none."""
        return 0.0

    def rest_length_vjp(self, x: Array, bar: float) -> Array:
        """Return the cotangent of x (n, D)."""
        return np.zeros(x.shape)

    def rest_size(self, x: Array, constants: Array) -> float:
        """Return the length at rest, or another size, of a part whose points at rest are x (n, D) [m]; see `Levels`."""
        return self.rest_length(x)

    def rest_size_vjp(self, x: Array, constants: Array, bar: float) -> Array:
        """Return the cotangent of x (n, D)."""
        return self.rest_length_vjp(x, bar)

    def problem(self, x: Array, dx: float) -> str | None:
        """Return the error in a part whose particles at rest are x (n, D) [m], with cells of dx [m], or None."""
        return None

    def greatest_acceleration(self, strength: float) -> float:
        """Return the acceleration that a part gives its particles, independent of their mass [m/s^2]."""
        return 0.0

    def wave_modulus(self) -> float:
        """Return the stiffness of a pressure wave that one unit of activation and strength adds."""
        return 0.0

    def stiffness_at_nodes(self, strength: float, x: Array) -> float:
        """Return the stiffness that a part adds to the grid nodes near its particles, at rest at x (n, D) [N/m]."""
        return 0.0


class RegionActuator(Actuator):
    """An actuator on the particles of a region, or of several groups with separate activations."""

    region: Annotated[Chosen[Plugin], Choice("region")] | None = Field(
        description="Region at rest; the whole body if absent", default=None
    )
    each: list[GroupName] | None = Field(
        description="Groups of the body, each with an activation of its own", min_length=1, default=None
    )

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions, and contradictions."""
        groups = self.each or []
        problems = super().dim_problems(dim) + [
            (("each", k), f"'{group}' is named twice: a group has one activation")
            for k, group in enumerate(groups)
            if group in groups[:k]
        ]
        if self.region is not None and self.each is not None:
            message = "cannot be combined with `each`: give one of the two, or name a region of the scene in `each`"
            problems.append((("region",), message))
        return problems

    def parts(self) -> tuple[str, ...]:
        """Return the names of its parts; a single part has an empty name."""
        return tuple(self.each) if self.each is not None else ("",)

    def particles(self, part: str, x: Array, inside: Inside) -> Array:
        """Return the particles of a part; see `Actuator.particles`."""
        return inside(self.body, part if self.each is not None else self.region)


class DirectedStress(RegionActuator):
    """A stress F S F^T with S along an axis of the body at rest, or isotropic."""

    weight: float = quantity(
        "1", "Share of the strength that each particle has; as an unknown with `per: field`, it places the actuator",
        differentiable=True, ge=0, default=1.0,
    )  # fmt: skip
    axis: list[float] | Literal["isotropic"] = Field(description="Direction at rest, of any length; or isotropic")

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        problems = super().dim_problems(dim)
        if isinstance(self.axis, list) and len(self.axis) != dim:
            problems.append((("axis",), f"must have {dim} entries in this {dim}D world, has {len(self.axis)}"))
        elif isinstance(self.axis, list) and not np.any(self.axis):
            problems.append((("axis",), "must not be zero; give a direction, or isotropic"))
        return problems

    def wave_modulus(self) -> float:
        """Return the stiffness of a pressure wave that one unit of activation and strength adds."""
        return 1.0

    def potential(self, constants: Array, x: Array, F: Array) -> Array:
        """Return the energy per volume at rest (T, n) whose derivative by F (T, n, D, D) is its stress P = F S.

        It is S : F^T F / 2, for an activation and a strength of 1.
        """
        return np.asarray(0.5 * np.einsum("tnki,tnkj,ij->tn", F, F, full(constants)))

    def potential_vjp(self, constants: Array, x: Array, F: Array, bar: Array) -> tuple[Array | None, Array | None]:
        """Return the cotangents of x and F; None for zero."""
        return None, bar[..., None, None] * (F @ full(constants))

    def direction(self, dim: int) -> Array:
        """Return n n^T of the unit axis n, or I (D, D)."""
        if self.axis == "isotropic":
            return np.eye(dim)
        n = np.array(self.axis) / np.linalg.norm(self.axis)
        return np.outer(n, n)


def full(rows: Array) -> Array:
    """Return the symmetric matrix (D, D) of its rows: diagonal first, then 01 (02 12)."""
    dim = 2 if len(rows) == 3 else 3
    i, j = np.triu_indices(dim, 1)
    S = np.diag(rows[:dim])
    S[i, j] = S[j, i] = rows[dim:]
    return S


def within_limits(wanted: Array, previous: Array, low: Array, high: Array, change: Array) -> tuple[Array, Array, Array]:
    """Limit activations to their range and to `change` from the previous ones.

    At a limit the derivative by `wanted` is 1, so that an optimizer can move back inside.

    Args:
        wanted: requested activations (A,).
        previous: activations of the previous control step (A,); neutral ones for the first.
        low, high: limits (A,).
        change: largest change in a control step (A,), infinite if unlimited.

    Returns:
        The activations, and their derivatives by `wanted` and by `previous`, each (A,) of 0 and 1.
    """
    clipped = np.clip(wanted, low, high)
    by_wanted = ((wanted >= low) & (wanted <= high)).astype(float)
    given = np.clip(clipped, previous - change, previous + change)
    late = given != clipped
    return given, np.where(late, 0.0, by_wanted), late.astype(float)
