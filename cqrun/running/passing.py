"""Bodies that pass through each other, through themselves, into an obstacle or out of the world, seen afterwards.

Contact of the reference frame pushes surfaces apart, but a body that is carried or thrown fast enough gets through, and
a body never meets itself, nor do the walls of its chambers. So particles are looked at now and then: is one of them
inside other matter? The test pulls it back to the rest shape of its nearest neighbour j of the other matter,
X_j + F_j^-1 (x_i - x_j). There it counts if it is near j, and j is not at a surface. In the updated frame, bodies share
a grid and cannot pass.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from cqrun.actuators.chamber import is_chamber
from cqrun.build.model import Built
from cqrun.build.regions import boundary
from cqrun.build.surfaces import skin_of, surface_of
from cqrun.plugin.contract import Array
from cqrun.state import State

LOOKS = 60
"""Control steps of a run that are looked at, at most, besides the last."""

DEEP = 0.25
"""Depth inside an obstacle from which it is told, beyond half a spacing of particles [cells]."""

UNDER = 0.6
"""Depth of a particle under the surface of its body at rest from which it counts as inside [cells]."""

NEAR = 0.6
"""Distance from such a particle at which another lies in the same place [spacings]."""

TOUCH = 0.25
"""Distance of two points of a surface from which they touch, if they are `FAR_ON_SURFACE` apart at rest [cells]."""

FAR_ON_SURFACE = 1.0
"""Walls are thin, and gaps between them narrow [cells]."""

FARTHEST = 2**19
"""Cells from the middle particle beyond which all particles count as in one place; a run that blows up has such."""

FAR = 4.0
"""Distance at rest from which parts of one body count as different matter [cells]."""


class Passing:
    """Looks at the states of one run, and notes when something first was where it cannot be."""

    def __init__(self, built: Built) -> None:
        self.built, self.seen = built, {}  # type: tuple[Built, dict[tuple[str, ...], tuple[str, int]]]
        self.every = max(1, built.model.n_controls // LOOKS)
        slices = built.model.layout.slices()
        self.body = np.repeat(np.arange(len(slices)), [part.stop - part.start for part in slices])
        self.depth: Array | None = None

    def at_control(self, control: int, state: State) -> None:
        """Look at the state of a control step, if it is one of those that are looked at."""
        if control % self.every == 0 or control == self.built.model.n_controls:
            self.look(f"t = {control * self.built.scene.time.control_step:.4g} s", state)

    def look(self, when: str, state: State) -> None:
        """Look at a state, which `when` names in findings."""
        if self.built.model.frame != "reference" or not np.isfinite(state.x).all():
            return
        for key, count in (
            *self._outside(state.x),
            *self._in_obstacles(state.x),
            *self._overlaps(state),
            *self._walls(state),
        ):
            self.seen.setdefault(key, (when, count))

    def findings(self) -> Iterator[str]:
        """Yield a sentence on each thing that was seen."""
        for (kind, *names), (when, count) in self.seen.items():
            where = f"{when} ({count} particle{'s' * (count > 1)})"
            if kind == "world":
                yield (
                    f"'{names[0]}' leaves the world at {where}: the reference frame goes on without an edge; enlarge "
                    "world.size, or hold it back by a boundary"
                )
            elif kind == "obstacle":
                yield (
                    f"'{names[0]}' is inside the obstacle `{names[1]}` from {where}: it was pressed or thrown through "
                    "its surface, and what follows is not physical; move it less or more slowly, or use smaller "
                    "substeps or a stiffer material"
                )
            elif kind == "walls":
                yield (
                    f"walls of '{names[0]}' touch at {when} ({count} points of its surface): in the reference frame "
                    "they pass through each other, and what follows is not physical; use less pressure, a stiffer "
                    "material or a wider gap"
                )
            elif kind == "bodies":
                yield (
                    f"'{names[0]}' and '{names[1]}' are in the same place from {where}: contact did not keep them "
                    "apart, and what follows is not physical; move them less or more slowly, use smaller substeps or a "
                    "stiffer material; if they should merge, use `world.frame: updated`"
                )
            else:
                yield (
                    f"parts of '{names[0]}' are in the same place from {where}: a body of the reference frame does not "
                    "touch itself, so they pass through each other; use `world.frame: updated`, or make them two bodies"
                )

    def _outside(self, x: Array) -> Iterator[tuple[tuple[str, ...], int]]:
        out = (x < 0) | (x > np.array(self.built.scene.world.size))
        yield from self._by_body("world", np.any(out, axis=1))

    def _by_body(self, kind: str, mask: Array, *more: str) -> Iterator[tuple[tuple[str, ...], int]]:
        for k, count in enumerate(np.bincount(self.body[mask], minlength=len(self.built.particles.names))):
            if count:
                yield (kind, self.built.particles.names[k], *more), int(count)

    def _in_obstacles(self, x: Array) -> Iterator[tuple[tuple[str, ...], int]]:
        scene, size = self.built.scene, np.array(self.built.scene.world.size)
        steps = DEEP * scene.world.dx * np.array([*np.eye(scene.dim), *-np.eye(scene.dim)])
        for name in scene.boundaries:
            spec: Any = boundary(scene, name)
            if spec.is_obstacle:
                deep = np.arange(len(x))
                for step in (np.zeros(scene.dim), *steps):
                    deep = deep[np.any([inside for inside, _ in spec.places(x[deep] + step, size)], axis=0)]
                mask = np.zeros(len(x), bool)
                mask[deep] = True
                yield from self._by_body("obstacle", mask, name)

    def _overlaps(self, state: State) -> Iterator[tuple[tuple[str, ...], int]]:
        """Yield bodies with a particle of one inside the other, and those with parts inside each other."""
        i, j = self._strangers(state.x)
        if not len(i):
            return
        names, spacing = self.built.particles.names, self.built.particles.spacing
        room = NEAR * np.array([spacing[name] for name in names])[self.body[j]]
        with np.errstate(all="ignore"):
            back = np.linalg.pinv(state.F[j]) @ (state.x[i] - state.x[j])[..., None]
        near = np.linalg.norm(back[..., 0], axis=1) < room
        inside = near & (self._depths()[j] > UNDER * self.built.model.dx)
        pairs = np.sort(np.stack([self.body[i], self.body[j]], axis=1)[inside], axis=1)
        for a, b in np.unique(pairs, axis=0):
            own = inside.copy()
            own[inside] = (pairs == (a, b)).all(axis=1)
            key = ("self", names[a]) if a == b else ("bodies", names[a], names[b])
            yield key, len(np.unique(i[own]))

    def _strangers(self, x: Array) -> tuple[Array, Array]:
        """Return ordered pairs of particles that are near each other and of different matter."""
        X, dx = self.built.particles.x, self.built.model.dx
        mixed = np.flatnonzero(_mixed(x, X, self.body, dx))
        if not len(mixed):
            return mixed, mixed
        pairs = mixed[cKDTree(x[mixed]).query_pairs(0.5 * dx, output_type="ndarray")]
        apart = np.linalg.norm(X[pairs[:, 0]] - X[pairs[:, 1]], axis=1) > FAR * dx
        pairs = pairs[apart | (self.body[pairs[:, 0]] != self.body[pairs[:, 1]])]
        return np.concatenate([pairs[:, 0], pairs[:, 1]]), np.concatenate([pairs[:, 1], pairs[:, 0]])

    def _walls(self, state: State) -> Iterator[tuple[tuple[str, ...], int]]:
        """Yield bodies with chambers of which points of the surface touch others that are apart at rest."""
        dx, particles = self.built.model.dx, self.built.particles
        for name in {part.spec.body: None for part in self.built.assembly.actuation.parts if is_chamber(part.spec)}:
            skin = skin_of(self.built.scene, particles, name)
            offset = skin.x - particles.x[skin.particle]
            x = state.x[skin.particle] + np.einsum("sij,sj->si", state.F[skin.particle], offset)
            i, j = cKDTree(x).query_pairs(TOUCH * dx, output_type="ndarray").T
            apart = np.linalg.norm(skin.x[i] - skin.x[j], axis=1) > FAR_ON_SURFACE * dx
            if apart.any():
                yield ("walls", name), len(np.unique([i[apart], j[apart]]))

    def _depths(self) -> Array:
        """Return how far the particles are under the surfaces of their bodies at rest (N,) [m]; they are found once."""
        if self.depth is None:
            surface, particles = surface_of(self.built.scene, self.built.particles), self.built.particles
            self.depth = np.concatenate([
                cKDTree(surface.x[begin:end]).query(particles.x[particles.of(name)])[0]
                for name, begin, end in zip(particles.names, surface.begin, surface.begin[1:], strict=False)
            ])  # fmt: skip
        return self.depth


def _mixed(x: Array, X: Array, body: Array, dx: float) -> Array:
    """Return the particles (N,) as bool that share a cell, or touch one, with matter that is far away at rest."""
    out, dim = np.zeros(len(x), bool), x.shape[1]
    for shift in product((0.0, 0.5), repeat=dim):  # so that near pairs share a cell of one of the grids
        places = np.nan_to_num(x / dx + np.array(shift))
        cell = np.floor(np.clip(places - np.median(places, axis=0), -FARTHEST, FARTHEST)).astype(np.int64)
        cell -= cell.min(axis=0)
        number = np.ravel_multi_index(tuple(cell.T), tuple(cell.max(axis=0) + 1))
        order = np.argsort(number, kind="stable")
        begin = np.flatnonzero(np.diff(number[order], prepend=-1))
        keys = np.concatenate([X, body[:, None] * 1e3 * (FAR * dx + np.ptp(X))], axis=1)[order]
        spread = np.maximum.reduceat(keys, begin) - np.minimum.reduceat(keys, begin)
        far = (spread > FAR * dx / np.sqrt(dim)).any(axis=1)
        out[order] |= np.repeat(far, np.diff([*begin, len(x)]))
    return out
