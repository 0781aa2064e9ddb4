"""What a rollout writes down of a body at every control step, and its cotangent."""

from __future__ import annotations

from typing import NamedTuple

from cqrun.contract import Array


class Record(NamedTuple):
    """Weighted means over particles, K of them, at times t * control_step for t = 0 .. T.

    Attributes:
        x: (T+1, K, D) position [m].
        v: (T+1, K, D) velocity [m/s].
        C: (T+1, K, D, D) affine velocity matrix, the velocity's gradient [1/s].
        F: (T+1, K, D, D) deformation gradient [1].
    """

    x: Array
    v: Array
    C: Array
    F: Array
