"""What a scene's gradients need: states kept, substeps run again; refused before a run where it cannot be."""

from __future__ import annotations

import numpy as np

from cqrun.engine.blocks import SORT_EVERY
from cqrun.engine.checkpoint import Plan, make_plan
from cqrun.engine.model import Model
from cqrun.errors import Problem, RunError, SceneError
from cqrun.scene.build import Built
from cqrun.state import rows_of


def state_bytes(model: Model) -> int:
    """Return the bytes of one kept state."""
    return int(rows_of(model.dim)[-1] * model.layout.n * np.dtype(model.real).itemsize)


def least_budget(bytes_of_state: int) -> int:
    """Return the least budget that a gradient runs in [bytes]: the shortest chunk, its end and one more state."""
    return (SORT_EVERY + 2) * bytes_of_state


def gradient_plan(built: Built) -> Plan:
    """Return how a gradient of a scene fits its memory.

    Raises:
        SceneError: it does not.
    """
    model = built.model
    try:
        return make_plan(model.n_steps, state_bytes(model), model.memory_budget)
    except RunError as error:
        raise SceneError([Problem(built.scene.where("memory"), "memory", str(error))]) from None
