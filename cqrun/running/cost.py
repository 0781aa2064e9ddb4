"""How long a rollout and a run will take: an estimate for one core, made before anything is run."""

from __future__ import annotations

from importlib.util import find_spec

from cqrun.engine.checkpoint import make_plan
from cqrun.engine.model import Model
from cqrun.running.gradient_memory import GRADIENT

NANOSECONDS = {2: 30.0, 3: 95.0}
"""What a particle and substep typically take forward on one core, by the dimension (`cqrun bench` measures it)."""


START, OUTPUT = 1.8, 2e-3
"""Measured times [s]: to start, with kernels that are compiled already, and to write a control step of a motion."""

PICTURES, FILM, DOT = 1.1, {2: 0.015, 3: 0.1}, 4e-6
"""Measured times [s]: pictures and report of a run; a picture of its film, by dimension; a particle in it, in 2D."""

MOST_FRAMES, FEW_FRAMES = 48, 12
"""Pictures of a report's film at most; and of many particles, which take long to draw."""

MOST_DOTS = 1_500_000
"""Particles that are drawn in all pictures of a film together, about."""

SHORT = 0.1
"""A shorter time is not told [s]: calls and files take longer."""


def forward_seconds(model: Model) -> float:
    """Return the time of a rollout [s]."""
    return 1e-9 * NANOSECONDS[model.dim] * model.layout.n_particles * model.n_steps


def gradient_seconds(model: Model) -> float:
    """Return the time of a rollout and its gradient [s].

    Raises:
        RunError: a gradient needs more memory than the scene allows.
    """
    plan = make_plan(model.n_steps, model.state_bytes, model.memory_budget)
    return forward_seconds(model) * (GRADIENT + plan.recompute - 1.0)


def film_step(frames: int, particles: int) -> int:
    """Return the least n for which a report's film of every n-th frame of a trajectory is short enough."""
    most = min(MOST_FRAMES, max(FEW_FRAMES, MOST_DOTS // particles))
    return max(1, -(-(frames - 1) // most))


def picture_seconds(dim: int, particles: int, frames: int) -> float:
    """Return the time of pictures, report and film of a trajectory with numbers of particles and of frames [s].

    Films in 3D are drawn only if pyvista is installed.
    """
    if dim == 3 and find_spec("pyvista") is None:
        return PICTURES
    drawn = -(-frames // film_step(frames, particles))
    return PICTURES + drawn * (FILM[dim] + (DOT * particles if dim == 2 else 0.0))


def duration(seconds: float) -> str:
    """Return a time as text, such as `0.24 s`, `3.5 min` or `2.1 h`."""
    if seconds < 99.5:
        return f"{seconds:.2g} s"
    return f"{seconds / 60:.2g} min" if seconds < 5970.0 else f"{seconds / 3600:.2g} h"


def about(model: Model, *, gradients: bool = False, each: str = "a rollout") -> str:
    """Return words on the time of a rollout, or of one with its gradient."""
    seconds = gradient_seconds(model) if gradients else forward_seconds(model)
    lasts = f"about {duration(seconds)}" if seconds >= SHORT else f"less than {duration(SHORT)}"
    return f"{lasts} {each}{' and its gradient' if gradients else ''} on one core"
