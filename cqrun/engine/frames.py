"""The frames in which a model can move, and how to make a rollout of a model in its frame."""

from __future__ import annotations

from cqrun.engine.model import Inputs, Model
from cqrun.engine.policy import Policy
from cqrun.engine.reference.rollout import ReferenceRollout
from cqrun.engine.rollout import Rollout
from cqrun.engine.statics.settled import SettledRollout
from cqrun.engine.updated.rollout import UpdatedRollout

FRAMES: dict[str, type[Rollout]] = {"updated": UpdatedRollout, "reference": ReferenceRollout}


def make_rollout(
    model: Model, inputs: Inputs, *, threads: int = 1, adjoint: bool = False, policy: Policy | None = None
) -> Rollout:
    """Return a rollout of a model in its frame; see `ForwardRun` for the arguments."""
    kind = SettledRollout if model.settled else FRAMES[model.frame]
    return kind(model, inputs, threads=threads, adjoint=adjoint, policy=policy)
