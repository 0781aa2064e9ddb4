"""Whether a body stays of one piece and nowhere inside out, from the trajectory of a run."""

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

WHOLE = "the body stays whole and nowhere inside out"
"""What `checks` asks, in words."""

BEST = "in each run's best motion "
"""Put before that where distances are of the last motion: a run keeps its best one, which may be another."""

NOTE = "whole.json"
"""Beside a run: how whole its bodies stay."""


def watched(run: RunData, body: str) -> dict[str, Array]:
    """Return how whole a body is at each frame of a run's motion.

    `fracture` is the share of neighbouring particles that share no node of the grid any more.
    """
    fields, particles = run.trajectory().fields, sample(run.scene)
    part = particles.of(body)
    pairs = Fracture.of(particles.x, {body: part}, particles.spacing, run.scene.world.dx)
    lost = np.array([pairs.count(x)[body] for x in fields["x"]])
    return {"least_volume_ratio": fields["J"][:, part].min(axis=1), "fracture": lost / len(pairs.pairs[body])}


def worst(run: Path, body: str) -> dict[str, float]:
    """Return the worst of `watched` over the motion that a run has kept; nothing where nobody has looked at it.

    It is noted beside the run, whose motion is not packed for other machines.
    """
    note = run / NOTE
    if not (run / "trajectory.h5").exists():
        return dict(json.loads(note.read_text())) if note.exists() else {}
    seen = watched(read_run(run), body)
    found = {"least_volume_ratio": float(seen["least_volume_ratio"].min()), "fracture": float(seen["fracture"].max())}
    if read_record(run)["status"] in FINISHED and np.all(np.isfinite(list(found.values()))):
        write_json(note, found)
    return found


def checks(table: Mapping[str, Array], motions: int = 1, which: str = "") -> dict[str, bool]:
    """Return the checks that bodies are of one piece and nowhere inside out, of so many motions in a table.

    Rows without numbers (NaN) are of no motion; where a table has fewer numbers than motions, some were not recorded.

    Args:
        which: says which motions they are.
    """
    torn = table.get("fracture", np.empty(0))
    seen = np.isfinite(torn)
    if np.count_nonzero(seen) < motions:
        return {f"{which}whether the body stays whole was not recorded": False}
    most, least = float(torn[seen].max()), float(table["least_volume_ratio"][seen].min())  # NaN is not above nothing
    return {
        f"{which}the body stays whole: {most:.2%} of its neighbours part": most == 0.0,
        f"nowhere is it inside out: volumes are {least:.2f} of their own at least": least > 0.0,
    }
