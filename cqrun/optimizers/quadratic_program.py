"""Quadratic programs with many unknowns in a box, few constraints, and a Hessian of low rank plus diagonal.

An interior point method with Mehrotra's predictor and corrector. Woodbury's identity solves a system in the unknowns by
products with the few columns of W; the remaining system has the size of the constraints. So time and memory are linear
in the number of unknowns. J. Nocedal, S. Wright: Numerical optimization (2006), section 16.6.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from cqrun.plugin.contract import Array

MAX_ROUNDS = 80
PRECISE = 1e-11
"""Complementarity and residuals, in scaled units, at which the iteration ends."""

TO_BOUND = 0.995
"""Part of the distance to the nearest bound that a step may go."""

MIN_ROOM = 1e-15
"""Smallest distance of an unknown from its bound, in scaled units; rounding could make it zero."""

THIN = 1e-10
"""Half width, in scaled units, of the interval for an equality constraint."""


@dataclass(frozen=True)
class LowRank:
    """The symmetric matrix delta I - W M^-1 W^T, with W (n, k), M (k, k) and small k."""

    delta: float
    W: Array = field(default_factory=lambda: np.zeros((0, 0)))
    M: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def times(self, v: Array) -> Array:
        """Return the product with v (n,)."""
        if not len(self.M):
            return self.delta * v
        return np.asarray(self.delta * v - self.W @ np.linalg.solve(self.M, self.W.T @ v))

    def scaled(self, length: float, unit: float) -> LowRank:
        """Return length^2 / unit times the matrix."""
        return LowRank(self.delta * length**2 / unit, self.W * length, self.M * unit)

    def solve_with(self, diagonal: Array, right: Array) -> Array:
        """Solve (diag(diagonal) + the matrix) X = right (n, r)."""
        D = (self.delta + diagonal)[:, None]
        X = right / D
        if not len(self.M):
            return np.asarray(X)
        DW = self.W / D
        return np.asarray(X + DW @ np.linalg.solve(self.M - self.W.T @ DW, self.W.T @ X))


def quadratic_program(
    B: LowRank, g: Array, J: Array, ends: tuple[Array, Array], box: tuple[Array, Array], penalty: float
) -> tuple[Array, Array]:
    """Minimise g.d + d.B d / 2 with low <= J d <= high and d in a finite box; return d (n,) and multipliers y (m,).

    Multipliers are at most `penalty`. If no d in the box meets the constraints, `penalty` times the sum of violations
    is added to the objective.

    Args:
        ends: low and high (m,), may be infinite, or equal.
        box: lower and upper bounds of d (n,).
    """
    # in units of the box and of the objective's slope, with rows of J scaled to length 1
    length = float(np.max(box[1] - box[0], initial=0.0)) or 1.0
    unit = max(length * float(np.max(np.abs(g), initial=0.0)), B.delta * length**2) or 1.0
    norm = np.sqrt(np.einsum("ij,ij->i", J, J)) * length
    norm[norm == 0.0] = 1.0
    low, high = ends[0] / norm, ends[1] / norm
    equal = low == high
    low, high = low - THIN * equal, high + THIN * equal
    m = len(J)
    program = _Program(
        B.scaled(length, unit),
        np.concatenate([g * (length / unit), np.zeros(m), np.repeat(penalty * norm / unit, 2).reshape(m, 2).T.ravel()]),
        J * (length / norm)[:, None],
        np.concatenate([box[0] / length, low, np.zeros(2 * m)]),
        np.concatenate([box[1] / length, high, np.full(2 * m, np.inf)]),
    )
    d, y = program.solve()
    return np.clip(d * length, *box), y * unit / norm


@dataclass(frozen=True)
class _Program:
    """Minimise cost.z + d.B d / 2 over lower <= z <= upper, z = (d, t, p, q), where J d - t - p + q = 0.

    t is the wanted value of J d; p and q are the amounts by which J d is above and below it.
    """

    B: LowRank
    cost: Array
    J: Array
    lower: Array
    upper: Array

    def solve(self) -> tuple[Array, Array]:
        """Return d (n,) and the multipliers (m,) of the rows."""
        m, n = self.J.shape
        z, slopes = self._start(n, m)
        y = np.zeros(m)
        for _ in range(MAX_ROUNDS):
            room = np.maximum(z - self.lower, MIN_ROOM), np.maximum(self.upper - z, MIN_ROOM)
            dual = self.cost - slopes[0] + slopes[1] + self._transposed(y)
            dual[:n] += self.B.times(z[:n])
            primal = self._rows(z)
            mu = self._complementarity(room, slopes)
            if max(mu, np.max(np.abs(dual), initial=0.0), np.max(np.abs(primal), initial=0.0)) < PRECISE:
                break
            diagonal = slopes[0] / room[0] + slopes[1] / room[1]
            # the predictor aims at the bounds; the corrector uses the complementarity that the predictor would leave
            step = self._newton(diagonal, dual, primal, room, slopes, (-slopes[0], -slopes[1]))
            reach = self._reach(room, slopes, step)
            predicted = self._complementarity(*self._after(room, slopes, step, reach))
            centre = mu * (predicted / mu) ** 3 if mu > 0.0 else 0.0
            aims = (
                (centre - step[0] * step[2]) / room[0] - slopes[0],
                (centre + step[0] * step[3]) / room[1] - slopes[1],
            )
            step = self._newton(diagonal, dual, primal, room, slopes, aims)
            reach = TO_BOUND * self._reach(room, slopes, step)
            z, y = z + min(1.0, reach) * step[0], y + min(1.0, reach) * step[1]
            slopes = (slopes[0] + min(1.0, reach) * step[2], slopes[1] + min(1.0, reach) * step[3])
        return z[:n], y

    def _start(self, n: int, m: int) -> tuple[Array, tuple[Array, Array]]:
        """Return a point well inside, and slopes: 1 at every finite bound, and the cost for violations."""
        finite = np.isfinite(self.lower), np.isfinite(self.upper)
        width = np.where(finite[0] & finite[1], self.upper - self.lower, 10.0)
        z = np.zeros(n + 3 * m)
        z = np.where(finite[0], np.maximum(z, self.lower + 0.1 * width), z)
        z = np.where(finite[1], np.minimum(z, self.upper - 0.1 * width), z)
        slopes = finite[0] * 1.0, finite[1] * 1.0
        slopes[0][n + m :] = self.cost[n + m :]
        z[n + m :] = 1.0 / np.maximum(1.0, self.cost[n + m :])
        return z, slopes

    def _rows(self, z: Array) -> Array:
        n = self.J.shape[1]
        t, p, q = np.split(z[n:], 3)
        return np.asarray(self.J @ z[:n] - t - p + q)

    def _transposed(self, y: Array) -> Array:
        return np.concatenate([self.J.T @ y, -y, -y, y])

    def _newton(
        self, diagonal: Array, dual: Array, primal: Array, room: tuple[Array, Array], slopes: tuple[Array, Array],
        aims: tuple[Array, Array],
    ) -> tuple[Array, Array, Array, Array]:  # fmt: skip
        """Return the changes of z, y and both slopes; `aims` are the slopes' changes if z does not change."""
        n = self.J.shape[1]
        right = -dual + aims[0] - aims[1]
        X = self.B.solve_with(diagonal[:n], np.column_stack([right[:n], self.J.T]))
        rest = 1.0 / diagonal[n:]
        moved = np.concatenate([X[:, 0], right[n:] * rest])
        t, p, q = np.split(rest, 3)
        dy = np.linalg.solve(self.J @ X[:, 1:] + np.diag(t + p + q), primal + self._rows(moved))
        back = np.concatenate([X[:, 1:] @ dy, self._transposed(dy)[n:] * rest])
        dz = moved - back
        return dz, dy, aims[0] - slopes[0] / room[0] * dz, aims[1] + slopes[1] / room[1] * dz

    @staticmethod
    def _after(
        room: tuple[Array, Array], slopes: tuple[Array, Array], step: tuple[Array, Array, Array, Array], reach: float
    ) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        reach = min(1.0, reach)
        rooms = room[0] + reach * step[0], room[1] - reach * step[0]
        return rooms, (slopes[0] + reach * step[2], slopes[1] + reach * step[3])

    @staticmethod
    def _complementarity(room: tuple[Array, Array], slopes: tuple[Array, Array]) -> float:
        """Return the mean product of room and slope over all bounds."""
        products = [r[there] * s[there] for r, s in zip(room, slopes, strict=True) for there in [np.isfinite(r)]]
        return float(sum(p.sum() for p in products)) / max(1, sum(len(p) for p in products))

    @staticmethod
    def _reach(
        room: tuple[Array, Array], slopes: tuple[Array, Array], step: tuple[Array, Array, Array, Array]
    ) -> float:
        """Return the largest fraction of a step after which all rooms and slopes are still positive."""
        reach = np.inf
        for value, change in ((room[0], step[0]), (room[1], -step[0]), (slopes[0], step[2]), (slopes[1], step[3])):
            falls = (change < 0.0) & np.isfinite(value) & (value > 0.0)
            if falls.any():
                reach = min(reach, float(np.min(-value[falls] / change[falls])))
        return reach
