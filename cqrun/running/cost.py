"""How long a rollout will take: an estimate for one core, made before anything is run."""

from __future__ import annotations

from cqrun.engine.checkpoint import make_plan
from cqrun.engine.model import Model
from cqrun.running.gradient_memory import GRADIENT

NANOSECONDS = {2: 30.0, 3: 95.0}
"""What a particle and substep typically take forward on one core, by the dimension (`cqrun bench` measures it)."""


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
