"""Whether a body holds together and no particle is inverted, from the trajectory of a run."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from cqrun.build.particles import sample
from cqrun.figures.run_data import RunData, read_run
from cqrun.observers.fracture import Fracture
from cqrun.plugin.contract import Array
from cqrun.store.atomic import write_json
from cqrun.store.run import FINISHED, read_record

INTACT = "the body holds together and no particle is inverted"
"""What `checks` asks for."""

IN_BEST = "in each run's best motion "
"""Stands before INTACT where distances are of the last motion. A run keeps its best motion, which may be another."""

NOTE = "whole.json"
"""Beside a run: what `worst` has found."""


def watch(run: RunData, body: str) -> dict[str, Array]:
    """Return how well a body holds together in each frame of a run's motion.

    Returns:
        least_volume_ratio: of all its particles, det F.
        fracture: the share of pairs of neighbouring particles that no longer share a node of the grid.
    """
    fields, particles = run.trajectory().fields, sample(run.scene)
    part = particles.of(body)
    pairs = Fracture.of(particles.x, {body: part}, particles.spacing, run.scene.world.dx)
    lost = np.array([pairs.count(x)[body] for x in fields["x"]])
    return {"least_volume_ratio": fields["J"][:, part].min(axis=1), "fracture": lost / len(pairs.pairs[body])}


def worst(run: Path, body: str) -> dict[str, float]:
    """Return the worst values of `watch` over the motion that a run has kept; nothing if they are not known.

    They are noted beside the run, because motions are not packed for other machines.
    """
    note = run / NOTE
    if not (run / "trajectory.h5").exists():
        return dict(json.loads(note.read_text())) if note.exists() else {}
    seen = watch(read_run(run), body)
    values = {"least_volume_ratio": float(seen["least_volume_ratio"].min()), "fracture": float(seen["fracture"].max())}
    if read_record(run)["status"] in FINISHED and np.all(np.isfinite(list(values.values()))):
        write_json(note, values)
    return values


def checks(table: Mapping[str, Array], motions: int = 1, which: str = "") -> dict[str, bool]:
    """Return the checks that bodies hold together and no particle is inverted.

    Args:
        table: rows without numbers (NaN) belong to no motion.
        motions: how many motions the table should have; if it has fewer, some were not recorded.
        which: says in which motions.
    """
    fracture = table.get("fracture", np.empty(0))
    seen = np.isfinite(fracture)
    if np.count_nonzero(seen) < motions:
        return {f"it was not recorded whether {which}the body holds together": False}
    most, least = float(fracture[seen].max()), float(table["least_volume_ratio"][seen].min())  # NaN is not above 0
    return {
        f"{which}the body holds together: {100 * most:.2f} % of neighbouring particles separate": most == 0.0,
        f"no particle is inverted: the least volume ratio is {least:.2f}": least > 0.0,
    }
