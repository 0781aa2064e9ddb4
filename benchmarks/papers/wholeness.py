"""Whether a body stays of one piece and nowhere inside out, from the trajectory of a run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from benchmarks.papers.figure import Judgement, Verdict
from cqrun.contract import Array
from cqrun.figures.run_data import RunData, read_run
from cqrun.observers.fracture import Fracture
from cqrun.scene.particles import sample

WHOLE = "the body stays whole and nowhere inside out"
"""What `checks` asks, in words."""


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
    """Return the worst of `watched` over the motion that a run has kept; nothing where it has none, as elsewhere."""
    if not (run / "trajectory.h5").exists():
        return {}
    seen = watched(read_run(run), body)
    return {"least_volume_ratio": float(seen["least_volume_ratio"].min()), "fracture": float(seen["fracture"].max())}


def asked_whole(verdict: Verdict, whole: Mapping[str, bool]) -> Verdict:
    """Return a verdict with the checks on its bodies: where they fail it is met in part at best."""
    judgement = verdict.judgement
    if judgement is not Judgement.MISSED and not all(whole.values()):
        judgement = Judgement.PARTLY
    return Verdict(judgement, {**verdict.checks, **whole})


def checks(table: Mapping[str, Array], motions: int = 1) -> dict[str, bool]:
    """Return the checks that bodies are of one piece and nowhere inside out, of so many motions in a table.

    Rows without numbers (NaN) are of no motion; where a table has fewer numbers than motions, some were not recorded.
    """
    torn = table.get("fracture", np.empty(0))
    known = int(np.count_nonzero(np.isfinite(torn)))
    if known < motions:
        return {"whether the body stays whole was not recorded": False}
    most, least = float(np.nanmax(torn)), float(np.nanmin(table["least_volume_ratio"]))
    return {
        f"the body stays whole: {most:.2%} of its neighbours part": most == 0.0,
        f"nowhere is it inside out: volumes are {least:.2f} of their own at least": least > 0.0,
    }
