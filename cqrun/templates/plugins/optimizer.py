"""An optimizer of your own: a method that takes steps along gradients.

Here each step has the same length in every unknown, whatever the size of the gradient. Bounds, mini-batches, failed
trials and resumed runs are taken care of by the base class.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from cqrun.optimizers.descent import Descent
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin


@plugin("optimizer", "my_optimizer")
class MyOptimizer(Descent):
    """Steps of one length against the sign of a mean gradient: m <- memory m + (1 - memory) g, x <- x - rate sign(m).

    This text is the page of the optimizer: `cqrun describe optimizer my_optimizer --plugin my_optimizer.py`.
    """

    learning_rate: float = Field(0.02, gt=0, description="Length of the steps, in scaled coordinates")
    memory: float = Field(0.5, ge=0, lt=1, description="Part of the last mean gradient in the next one")

    def memory_names(self) -> tuple[str, ...]:
        """Return the names of the arrays (n,) that it remembers from step to step; they start at zero."""
        return ("m",)

    def direction(self, iteration: int, grad: Array, memory: dict[str, Array]) -> tuple[Array, dict[str, Array]]:
        """Return the direction (n,) that is multiplied by the learning rate and subtracted, and the new memory."""
        m = self.memory * memory["m"] + (1.0 - self.memory) * grad
        return np.sign(m), {"m": m}
