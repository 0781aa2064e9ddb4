"""Recording weighted sums of particles at control steps, and the adjoint. One thread runs these."""

from __future__ import annotations

from cqrun.compile import kernel
from cqrun.contract import Array
from cqrun.engine.setting import Probe


@kernel
def record(probe: Probe, q: Array, out: Array) -> None:
    """out[row, k] = sum_p W[k, p] q[row, p], q packed."""
    width = q.shape[2]
    for row in range(q.shape[1]):
        for k in range(len(probe.start) - 1):
            total = 0.0
            for index in range(probe.start[k], probe.start[k + 1]):
                p = probe.columns[index]
                total += probe.weights[index] * q[p // width, row, p % width]
            out[row, k] = total


@kernel
def record_vjp(probe: Probe, q_bar: Array, out_bar: Array) -> None:
    """Add the cotangent of a record to that of the state."""
    width = q_bar.shape[2]
    for row in range(q_bar.shape[1]):
        for k in range(len(probe.start) - 1):
            for index in range(probe.start[k], probe.start[k + 1]):
                p = probe.columns[index]
                q_bar[p // width, row, p % width] += probe.weights[index] * out_bar[row, k]
