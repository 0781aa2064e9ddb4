"""Write reactions.csv: the force and the moment with which each boundary and rigid body acts on the soft bodies.

time                              end of the control step [s]; all other columns are means over the step
<boundary>.force_x, ...           [N; 2D: N/m]
<boundary>.moment[_x, ...]        about the centre of what a clamp holds at rest, that of a rigid body, or the world's
                                  origin [N m; 2D: N]
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from cqrun.build.model import Built
from cqrun.plugin.contract import Array
from cqrun.running.rest_table import AXES, names_of
from cqrun.store.atomic import write_table
from cqrun.store.reactions import BoundaryForce, Reactions


def with_reactions(built: Built) -> Built:
    """Return a scene whose runs record the reactions of all boundaries and rigid bodies, if the frame knows them."""
    names = dict.fromkeys([plane.name for plane in built.model.conditions])
    names |= dict.fromkeys(body.name for body in built.model.rigid)
    if built.model.frame != "reference":
        return built
    return replace(built, model=replace(built.model, reactions=tuple(names)))


def write_reaction_table(path: Path, reactions: Reactions) -> None:
    """Write the table."""
    head, columns = ["time"], [reactions.time[:, None]]
    for name, force in reactions.force.items():
        moment = reactions.moment[name]
        axes = AXES[: force.shape[1]]
        moments = ["moment"] if moment.shape[1] == 1 else [f"moment_{axis}" for axis in axes]
        head += names_of(name, [*(f"force_{axis}" for axis in axes), *moments])
        columns += [force, moment]
    write_table(path, [head, *np.concatenate(columns, axis=1).tolist()])


def summary_of(held: Mapping[str, Array], dim: int) -> dict[str, BoundaryForce]:
    """Return the mean and the largest force of every boundary, from the reactions of records."""
    out = {}
    for name, rows in held.items():
        force = rows[1:, :dim]
        largest = float(np.linalg.norm(force, axis=1).max(initial=0.0))
        out[name] = BoundaryForce(mean=force.mean(axis=0).tolist(), largest=largest)
    return out
