"""Adam: steps whose length does not depend on the scale of the gradient."""

from __future__ import annotations

from typing import final

import numpy as np
from pydantic import Field

from cqrun.optimizers.descent import Descent
from cqrun.optimizers.first_order import FirstOrder
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin


class AdamSteps(FirstOrder):
    """Base of methods whose steps are Adam's, whatever merit they lower."""

    learning_rate: float = Field(0.02, gt=0, description="step length alpha in scaled coordinates")
    beta1: float = Field(0.9, ge=0, lt=1, description="memory of the mean gradient")
    beta2: float = Field(0.999, ge=0, lt=1, description="memory of the mean square")
    epsilon: float = Field(1e-8, gt=0, description="keeps the division finite")

    @final
    def memory_names(self) -> tuple[str, ...]:
        """Return the names of the two moments."""
        return ("m", "v")

    @final
    def direction(self, iteration: int, grad: Array, memory: dict[str, Array]) -> tuple[Array, dict[str, Array]]:
        """Return m^ / (sqrt(v^) + epsilon) (n,) and the new moments."""
        m = self.beta1 * memory["m"] + (1 - self.beta1) * grad
        v = self.beta2 * memory["v"] + (1 - self.beta2) * grad**2
        count = iteration + 1
        m_hat, v_hat = m / (1 - self.beta1**count), v / (1 - self.beta2**count)
        return m_hat / (np.sqrt(v_hat) + self.epsilon), {"m": m, "v": v}


@plugin("optimizer", "adam")
class Adam(AdamSteps, Descent):
    """Adam: x <- x - alpha m^ / (sqrt(v^) + epsilon), projected onto the bounds.

    m <- beta1 m + (1 - beta1) g, v <- beta2 v + (1 - beta2) g^2, m^ = m / (1 - beta1^k),
    v^ = v / (1 - beta2^k). For noisy or badly scaled gradients and mini-batches of recordings.
    D. P. Kingma, J. Ba: Adam: a method for stochastic optimization, ICLR 2015, algorithm 1.
    """
