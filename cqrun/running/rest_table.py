"""Write what a path of equilibria gives: rest.csv, one row per point, and the frames of its trajectory.

point, <key of the path> ...
residual                          net force divided by the loads
newton_steps, products, negative_curvature, smallest_eigenvalue
<body>.x, .y, .z                  centre of mass [m]
<body>.<group>.dx, .dy, .dz       mean displacement of a group [m]
<boundary>.force_x, ...           force with which a boundary holds the bodies [N; 2D: N/m]
<boundary>.moment[_x, ...]        its moment about the centre of what it holds at rest [N m; 2D: N]
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from cqrun.build.model import Built
from cqrun.engine.statics.equilibrium import Equilibrium
from cqrun.fingerprint import engine_hash
from cqrun.plugin.contract import Array
from cqrun.running.extra_fields import ExtraFields, groups_of
from cqrun.scene.load import dump, resolve
from cqrun.state import State
from cqrun.store.atomic import write_table
from cqrun.store.trajectory import TrajectoryWriter

AXES = "xyz"


def rest_frames(path: Path, built: Built, points: int, provenance: Mapping[str, Any] | None = None) -> TrajectoryWriter:
    """Return the writer of a trajectory with the rest shape and `points` frames; a frame's time is its number.

    `provenance` has more attributes of the file.
    """
    model, particles = built.model, built.particles
    bodies = {name: particles.of(name) for name in particles.names}
    attributes = {"scene": dump(resolve(built.scene)), "engine": engine_hash(), "seed": built.scene.seed}
    attributes |= provenance or {}
    fields = {"v": (model.dim,), "J": (), **ExtraFields(built).shapes}
    return TrajectoryWriter(path, points + 1, bodies, model.dim, fields, attributes, groups_of(built))


def write_frame(
    writer: TrajectoryWriter, state: State, number: int, more: Mapping[str, Array] = MappingProxyType({})
) -> None:
    """Write the particles at a point as a frame, with more fields by name."""
    J = np.linalg.det(state.F)
    writer.write(writer.written, float(number), x=state.x, v=state.v, J=J, **more)


class RestTable:
    """The rows of rest.csv."""

    def __init__(self, built: Built, points: Sequence[Mapping[str, float]]) -> None:
        self.built, self.points = built, points
        self.rows: list[dict[str, Any]] = []

    def add(self, here: Equilibrium, u: Array, facts: Mapping[str, Any]) -> None:
        """Add the row of a point."""
        k, axes = len(self.rows), AXES[: self.built.scene.dim]
        row: dict[str, Any] = {"point": k + 1, **self.points[k], "residual": facts["residual"]}
        row |= {"newton_steps": facts["steps"], "products": facts["products"]}
        row |= {"negative_curvature": int(facts["negative"]), "smallest_eigenvalue": facts["smallest"]}
        x, rest, mass = here.state(u).x, self.built.particles.x, here.rollout.inputs.fields.mass
        for name in self.built.particles.names:
            part = self.built.particles.of(name)
            centre = mass[part] @ x[part] / mass[part].sum()
            row |= {f"{name}.{axis}": float(c) for axis, c in zip(axes, centre, strict=True)}
            for group in self.built.scene.bodies[name].groups:
                chosen = self.built.particles.inside(name, group)
                moved = (x[chosen] - rest[chosen]).mean(axis=0)
                row |= {f"{name}.{group}.d{axis}": float(c) for axis, c in zip(axes, moved, strict=True)}
        self.rows.append(row | self._reactions(here, u))

    def _reactions(self, here: Equilibrium, u: Array) -> dict[str, float]:
        """Return the force and the moment of every boundary."""
        out: dict[str, float] = {}
        axes = AXES[: self.built.scene.dim]
        for name, (force, moment) in here.held_by(u).items():
            out |= {f"{name}.force_{axis}": float(f) for axis, f in zip(axes, force, strict=True)}
            names = ["moment"] if len(moment) == 1 else [f"moment_{axis}" for axis in axes]
            out |= dict(zip(names_of(name, names), map(float, moment), strict=True))
        return out

    def save(self, path: Path) -> None:
        """Write all rows."""
        if self.rows:
            head = list(self.rows[0])
            write_table(path, [head, *([_text(row[key]) for key in head] for row in self.rows)])


def names_of(owner: str, names: Sequence[str]) -> list[str]:
    """Return the names of an owner's columns."""
    return [f"{owner}.{name}" for name in names]


def _text(value: Any) -> Any:
    return "" if value is None else repr(value) if isinstance(value, float) else value
