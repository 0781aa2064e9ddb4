"""Stochastic gradient descent with momentum."""

from __future__ import annotations

from pydantic import Field

from cqrun.optimizers.descent import Descent
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin


@plugin("optimizer", "sgd")
class Sgd(Descent):
    """Gradient descent with momentum: u <- momentum u + g, x <- x - alpha u, projected onto the bounds.

    The simplest method, often with mini-batches of recordings (`batch_size: 1`).
    B. T. Polyak: Some methods of speeding up the convergence of iteration methods,
    USSR Comput. Math. Math. Phys. 4 (1964).
    """

    learning_rate: float = Field(0.01, gt=0, description="step alpha per unit of gradient, in scaled coordinates")
    momentum: float = Field(0.0, ge=0, lt=1, description="part of the last step that is added to the next one")

    def memory_names(self) -> tuple[str, ...]:
        """Return the name of the velocity."""
        return ("u",)

    def direction(self, iteration: int, grad: Array, memory: dict[str, Array]) -> tuple[Array, dict[str, Array]]:
        """Return u (n,), which is also the new memory."""
        u = self.momentum * memory["u"] + grad
        return u, {"u": u}
