"""A chamber: the pressure of a gas or a liquid on the walls of a closed cavity in a body (`forces/wall.py`).

A wall is the part of the body's surface around the cavity; its points ride on particles. A pressure p gives each point
the force p dV/dx, so the potential is -p V: the forces have no resultant and no moment, the work is p dV, and the
tangent is symmetric. Where the chamber is closed, p depends on V (`closed_chamber.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator
from scipy.spatial import cKDTree

from cqrun.actuators.actuator import Actuator
from cqrun.actuators.closed_chamber import ClosedKernel
from cqrun.errors import UsageError
from cqrun.explain import Loc, complaint, finding, listed
from cqrun.forces.force import ACTIVATION, STRENGTH, Inside, Levels, Riding, Shares, Skin, register_force
from cqrun.forces.wall import (
    across,
    cavities,
    each_facet,
    enclosed,
    enclosed_vjp,
    facet_work,
    facets_in,
    press_facet,
    press_facet_vjp,
    wall_constants,
    winding,
)
from cqrun.numerics.compile import kernel
from cqrun.plugin.choice import Choice, Chosen
from cqrun.plugin.contract import Array, Plugin, quantity
from cqrun.plugin.registry import plugin

SUPPLIES = ("pressure", "gas", "liquid")
"""What an activation sets; the field is its amount at activation 1."""


class ChamberKernel(NamedTuple):
    """All facets of the walls of a scene's chambers whose pressure is given; each is an item."""

    shares: Shares
    parts: Array
    constants: Array  # (I, 0)


@plugin("actuator", "chamber")
class Chamber(Actuator):
    """A hollow chamber in a body, under the pressure of a gas or a liquid on its walls as they move.

    A chamber is a closed cavity of the body's shape: a hole of a `difference`, or an inner shell of a mesh. There are
    no particles in it. All cavities of the body are on one line, unless `region`, `at` or `each` says which are meant.

    With `pressure`, a regulator sets the pressure: activation pressure, above that around the body (suction if it is
    negative). With `gas`, the chamber is closed and holds air; an activation of 1 adds the air that would raise its
    volume at rest to this pressure, at one temperature. With `liquid`, it is filled; an activation of 1 adds this share
    of its volume at rest. There, `rate` is the flow limit of a pump: activation 1/s.
    """

    pressure: float | None = quantity(
        "Pa", "Pressure at activation 1; or give `gas` or `liquid`", differentiable=True, default=None
    )
    gas: float | None = quantity(
        "Pa", "Pressure that the air added at activation 1 has in the volume at rest", differentiable=True, default=None
    )
    liquid: float | None = quantity(
        "1", "Volume added at activation 1, as a share of that at rest", differentiable=True, default=None
    )
    ambient: float = quantity("Pa", "Pressure around the body, for `gas`", gt=0, default=101325.0)
    bulk_modulus: float = quantity(
        "Pa", "Of the `liquid` and its hoses; 2.2e9 of water alone needs tiny substeps", gt=0, default=1.0e6
    )
    region: Annotated[Chosen[Plugin], Choice("region")] | None = Field(
        description="The cavities in this region share the line; all of the body's if absent", default=None
    )
    at: list[float] | list[list[float]] | None = quantity(
        "m", "A point in the cavity at rest, or a list of points if several share the line", default=None, min_length=1
    )
    each: dict[str, list[float]] | None = Field(
        description="Name -> a point in a cavity [m], each with an activation of its own", default=None, min_length=1
    )

    frame = "reference"

    @model_validator(mode="after")
    def _one_supply(self) -> Self:
        given = [name for name in SUPPLIES if getattr(self, name) is not None]
        if len(given) != 1:
            message = f"needs exactly one of `pressure`, `gas` and `liquid`; has {listed(given) if given else 'none'}"
            raise complaint("Chamber", [finding(message, involves=SUPPLIES)])
        chosen = [name for name in ("region", "at", "each") if getattr(self, name) is not None]
        if len(chosen) > 1:
            names = " and ".join(f"`{name}`" for name in chosen)
            message = f"{names} say which cavities are meant: give only one of them"
            raise complaint("Chamber", [finding(message, involves=tuple(chosen))])
        return self

    @property
    def scale(self) -> str:  # type: ignore[override]
        """The differentiable field that an activation is multiplied by."""
        return next(name for name in SUPPLIES if getattr(self, name) is not None)

    @property
    def kernel(self) -> type:  # type: ignore[override]
        """The class of the kernels' view."""
        return ChamberKernel if self.pressure is not None else ClosedKernel

    @property
    def limits(self) -> tuple[float, float]:
        """The smallest and largest activation."""
        return 0.0, 1.0

    @property
    def base(self) -> tuple[float, float]:
        """The numbers c and k of `closed_chamber.py`."""
        return (self.ambient, 1.0) if self.gas is not None else (self.bulk_modulus, self.bulk_modulus)

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        points: list[tuple[Loc, list[float]]] = [(("at",), point) for point in self._points()]
        points += [(("each", name), point) for name, point in (self.each or {}).items()]
        return super().dim_problems(dim) + [
            (loc, f"must have {dim} entries in this {dim}D world, has {len(point)}")
            for loc, point in points
            if len(point) != dim
        ]

    def _points(self) -> list[list[float]]:
        if self.at is None:
            return []
        return [point for point in self.at if isinstance(point, list)] or [
            [c for c in self.at if not isinstance(c, list)]
        ]

    def parts(self) -> tuple[str, ...]:
        """Return the names of its parts; a single part has an empty name."""
        return tuple(self.each) if self.each is not None else ("",)

    def particles(self, part: str, x: Array, inside: Inside) -> Array:
        """Return the particles of its body."""
        return inside(self.body, None)

    def constants(self, x: Array) -> Array:
        """Return nothing: `riding` has them."""
        return np.zeros(0)

    def riding(self, part: str, skin: Callable[[], Skin]) -> Riding:
        """Return the points of the walls on one line; the constants are D, c, k and the points of each facet.

        Raises:
            UsageError: it is not known which cavity is meant, or there is none.
        """
        surface = skin()
        walls = cavities(surface)
        if not walls:
            raise UsageError(
                f"'{self.body}' has no closed cavity: make one with `difference`, or a mesh with an inner shell; one "
                "that is open to the outside, or behind a wall thinner than half a cell, is none"
            )
        chosen = self._chosen(part, surface, walls)
        points, facets = np.unique(np.concatenate([walls[k] for k in chosen]), return_inverse=True)
        constants = wall_constants(facets.reshape(-1, surface.x.shape[1]), *self.base)
        return Riding(surface.particle[points], surface.x[points], constants)

    def _chosen(self, part: str, skin: Skin, walls: list[Array]) -> list[int]:
        """Return the numbers of the walls of a part."""
        if self.each is not None:
            found = {name: self._around(point, skin, walls) for name, point in self.each.items()}
            same = [name for name, k in found.items() if k == found[part] and name != part]
            if same:
                raise UsageError(
                    f"'{part}' and '{same[0]}' are in one cavity: the wall between them is open, or thinner than half "
                    "a cell; name one of them, or make the wall thicker"
                )
            return [found[part]]
        if self.region is not None:
            return self._within(skin, walls)
        points = self._points()
        return sorted({self._around(p, skin, walls) for p in points}) if points else list(range(len(walls)))

    def _within(self, skin: Skin, walls: list[Array]) -> list[int]:
        """Return the numbers of the walls that are in the region, seen from just inside their cavities."""
        found = []
        for k, wall in enumerate(walls):
            x = skin.x[wall].mean(axis=1) - 0.1 * across(skin.x, wall)
            if skin.pick(self.region, x, skin.particle[wall[:, 0]]).mean() > 0.5:
                found.append(k)
        if not found:
            raise UsageError(f"no cavity of '{self.body}' lies in the region; its cavities are: {_places(skin, walls)}")
        return found

    def _around(self, point: list[float], skin: Skin, walls: list[Array]) -> int:
        """Return the number of the wall around a point."""
        for k, wall in enumerate(walls):
            if abs(winding(skin.x, wall, np.array(point))) > 0.5:
                return k
        at = ", ".join(f"{c:.4g}" for c in point)
        raise UsageError(f"({at}) lies in no cavity of '{self.body}'; its cavities are: {_places(skin, walls)}")

    # --- volume and pressure ------------------------------------------------------------------------------------------

    def facets(self, constants: Array) -> Array:
        """Return the points of each facet (T, D) of a part's walls, from the part's constants."""
        return facets_in(constants)

    def rest_size(self, x: Array, constants: Array) -> float:
        """Return the volume at rest [m^D] of chambers whose points are at x (n, D) [m]."""
        return float(enclosed(x, facets_in(constants)))

    def rest_size_vjp(self, x: Array, constants: Array, bar: float) -> Array:
        """Return the cotangent of x (n, D)."""
        return enclosed_vjp(x, facets_in(constants), np.array(bar))

    def gauge(self, volume: Array, activation: Array, strength: float, rest: float) -> Array:
        """Return the pressure [Pa] above that around the body at each moment (T,), for volume and activation then."""
        if self.pressure is not None:
            return np.asarray(activation * strength + 0.0 * volume)
        c, k = self.base
        return np.asarray((c + activation * strength * k) * rest / volume - c)

    def gauge_vjp(
        self, volume: Array, activation: Array, strength: float, rest: float, bar: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Return the cotangents of volume, activation, strength and rest volume at each moment, all (T,)."""
        if self.pressure is not None:
            return 0.0 * bar, strength * bar, activation * bar, 0.0 * bar
        c, k = self.base
        held, full = c + activation * strength * k, rest / volume
        return -held * full / volume * bar, strength * k * full * bar, activation * k * full * bar, held / volume * bar

    def stored(self, volume: Array, activation: Array, strength: float, rest: float) -> Array:
        """Return the energy [J] whose derivative by the volume is minus the pressure (T,)."""
        if self.pressure is not None:
            return np.asarray(-activation * strength * volume)
        c, k = self.base
        return np.asarray(c * (volume - rest) - (c + activation * strength * k) * rest * np.log(volume / rest))

    def stored_vjp(
        self, volume: Array, activation: Array, strength: float, rest: float, bar: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Return the cotangents of volume, activation, strength and rest volume at each moment, all (T,)."""
        by_volume = -self.gauge(volume, activation, strength, rest) * bar
        if self.pressure is not None:
            return by_volume, -strength * volume * bar, -activation * volume * bar, 0.0 * bar
        c, k = self.base
        held, log = c + activation * strength * k, np.log(volume / rest)
        by_rest = -c - held * (log - 1.0)
        return by_volume, -strength * k * rest * log * bar, -activation * k * rest * log * bar, by_rest * bar

    def stiffness_at_nodes(self, strength: float, x: Array) -> float:
        """Return the stiffness against the turning of facets, about 4 p times their size [N/m].

        A closed chamber has the stiffness dp/dV |dV/dx|^2 as well, with all points moving outward: about c A / h for
        walls of the area A at a distance h from the middle, shared by their points.
        """
        size = float(cKDTree(x).query(x, 2)[0][:, 1].max())
        dim = x.shape[1]
        if self.pressure is not None:
            return 4.0 * abs(strength) * size ** (dim - 2)
        c, k = self.base
        middle = float(np.linalg.norm(x - x.mean(axis=0), axis=1).min())
        return 4.0 * abs(strength) * k * size ** (dim - 2) + c * dim * size ** (dim - 1) / max(middle, size)


def is_chamber(spec: object) -> bool:
    """Return whether an actuator is a chamber."""
    return isinstance(spec, Chamber)


def _places(skin: Skin, walls: list[Array]) -> str:
    def told(wall: Array) -> str:
        at = ", ".join(f"{c:.3g}" for c in skin.x[np.unique(wall)].mean(axis=0))
        return f"{enclosed(skin.x, wall):.3g} m^{skin.x.shape[1]} around ({at})"

    return "; ".join(told(wall) for wall in walls)


# --- in kernels: a given pressure -------------------------------------------------------------------------------------


@kernel
def swell(chambers: Any, item: int, levels: Levels, control: int, q: Array) -> None:
    """Write the shares of one facet of a chamber, or of a patch of the surface."""
    a = chambers.parts[item]
    press_facet(chambers.shares, chambers.shares.begin[item], levels.activation[control, a] * levels.strength[a], q)


@kernel
def swell_vjp(chambers: Any, item: int, levels: Levels, control: int, q: Array, push_bar: Array) -> None:
    """Carry the cotangent of the forces back through the facet's normal."""
    a, shares = chambers.parts[item], chambers.shares
    u, p = levels.activation[control, a], levels.strength[a]
    work, g = facet_work(shares, shares.begin[item], q, push_bar)
    shares.level_bar[item, :] = 0.0
    shares.level_bar[item, ACTIVATION], shares.level_bar[item, STRENGTH] = p * work, u * work
    press_facet_vjp(shares, shares.begin[item], u * p, 0.0, q, g)


register_force(ChamberKernel, each_facet, swell, swell_vjp, rate=False, own=slice(0, 0))
