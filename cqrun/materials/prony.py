"""A stress that relaxes: Simo's finite linear viscoelasticity, as finite-element programs have it.

The elastic law is the material's answer after a long time. Each branch i, with a ratio g_i and a time t_i, adds a
stress H_i that follows the changes of S, the law's second Piola-Kirchhoff stress without that of the volume, and fades:

    tau = F (sum_i H_i) F^T,   H_i' = a_i^2 H_i + g_i a_i (S(F') - S(F)),   a_i = exp(-dt/(2 t_i)),

    S = F^-1 (tau_elastic - J U'(J) I) F^-T

(Simo, Comput. Methods Appl. Mech. Eng. 60, 1987; Simo and Hughes, Computational Inelasticity, 1998, section 10.3). H is
symmetric, in the reference configuration, and zero at rest. At once the material is 1 + sum_i g_i times as stiff.

The state keeps Q_i = H_i - g_i a_i S(F), because what Q_i becomes in a substep does not depend on F at its end:

    Q_i' = a_i^2 Q_i + g_i a_i (a_i^2 - 1) S(F).

So the stress of a substep, which needs S in any case, gives Q_i' as well, and nothing else is kept. In motions, tau is
that of the law, too: F ((1 + sum_i g_i a_i) S + sum_i Q_i) F^T + J U'(J) I. A body has Q = 0 where it starts
undeformed, and Q_i = -g_i a_i S where it has rested for long.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numba.extending import register_jitable
from pydantic import PrivateAttr, model_validator

from cqrun.explain import complaint, finding
from cqrun.materials.branches import (
    all_rows,
    branch,
    dot_rows,
    in_branches,
    law_rows,
    scale_rows,
    summed,
    total,
)
from cqrun.materials.term import (
    MaterialTerm,
    add_rows,
    kirchhoff,
    kirchhoff_both,
    register,
    register_in_motion,
    register_settled,
    register_with_history,
    volume_slope,
    volume_slope_vjp,
    zeros_like_rows,
)
from cqrun.numerics.packed import pack, unpack
from cqrun.numerics.symmetric import from_rows, from_rows_vjp, to_rows, to_rows_vjp
from cqrun.numerics.tensor import add, cofactor, det, mul, mul_at, mul_bt, plus_diagonal, scale, symmetric, trace
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin
from cqrun.state import StateField

MOST = 5
"""Largest number of branches."""


class PronyKernel(NamedTuple):
    """Kernels' view at rest, where it has no stress: rows g_1, t_1 [s], ..., then those of the elastic law.

    `branches` has an entry for each branch, and `base` is the view of the law.
    """

    theta: Array
    rows: tuple[int, ...]
    branches: tuple[int, ...]
    base: Any


class RelaxingKernel(NamedTuple):
    """The view in motions, whose stress is that of the law, too: theta ends with rows a_i; `history` has those of Q."""

    theta: Array
    rows: tuple[int, ...]
    history: tuple[int, ...]
    branches: tuple[int, ...]
    base: Any


@plugin("material_term", "prony")
class Prony(MaterialTerm):
    """A stress that relaxes, in one to five branches: silicone is stiffer in a fast motion than at rest.

    The elastic law is the answer after a long time, in motion as well as in an equilibrium. A sudden change meets
    1 + ratio_1 + ratio_2 + ... times its stiffness, and each part fades with its time. The part of the law that depends
    on the volume alone does not relax. The state of a particle grows by 6 numbers for each branch (2D: by 3).
    """

    relaxes: ClassVar[bool] = True
    ratio_1: float = quantity("1", "Stiffness of branch 1, relative to the law's", differentiable=True, ge=0)
    time_1: float = quantity("s", "Relaxation time of branch 1", differentiable=True, gt=0)
    ratio_2: float | None = quantity("1", "Stiffness of branch 2", differentiable=True, ge=0, default=None)
    time_2: float | None = quantity("s", "Relaxation time of branch 2", differentiable=True, gt=0, default=None)
    ratio_3: float | None = quantity("1", "Stiffness of branch 3", differentiable=True, ge=0, default=None)
    time_3: float | None = quantity("s", "Relaxation time of branch 3", differentiable=True, gt=0, default=None)
    ratio_4: float | None = quantity("1", "Stiffness of branch 4", differentiable=True, ge=0, default=None)
    time_4: float | None = quantity("s", "Relaxation time of branch 4", differentiable=True, gt=0, default=None)
    ratio_5: float | None = quantity("1", "Stiffness of branch 5", differentiable=True, ge=0, default=None)
    time_5: float | None = quantity("s", "Relaxation time of branch 5", differentiable=True, gt=0, default=None)

    _law: Any = PrivateAttr(default=None)

    @model_validator(mode="after")
    def _whole_branches(self) -> Self:
        given = [tuple(getattr(self, f"{name}_{k}") is not None for name in ("ratio", "time")) for k in _EVERY]
        findings = [
            finding(f"branch {k} needs both ratio_{k} and time_{k}", (f"{'time' if ratio else 'ratio'}_{k}",))
            for k, (ratio, time) in zip(_EVERY, given, strict=True)
            if ratio != time
        ]
        count = sum(map(all, given))
        if not findings and not all(map(all, given[:count])):
            findings.append(finding(f"number the {count} branches from 1 on, without gaps", (f"ratio_{count + 1}",)))
        if findings:
            raise complaint("Prony", findings)
        return self

    def bind(self, law: Any) -> None:
        self._law = law

    @property
    def n_branches(self) -> int:
        """The number of branches."""
        return sum(getattr(self, f"ratio_{k}") is not None for k in _EVERY)

    @property
    def at_once(self) -> float:
        return 1.0 + sum(float(getattr(self, f"ratio_{k}")) for k in range(1, self.n_branches + 1))

    @property
    def times(self) -> tuple[float, ...]:
        """The relaxation times [s]."""
        return tuple(float(getattr(self, f"time_{k}")) for k in range(1, self.n_branches + 1))

    @property
    def parameters(self) -> tuple[str, ...]:
        """The rows of theta: those of the branches, then the law's."""
        own = (f"{name}_{k}" for k in range(1, self.n_branches + 1) for name in ("ratio", "time"))
        return (*own, *(() if self._law is None else self._law.parameters))

    def kernel_term(self, theta: Array) -> PronyKernel:
        n = self.n_branches
        return PronyKernel(theta, (0,) * len(self.parameters), (0,) * n, self._law.kernel_term(theta))

    def history(self, dim: int) -> tuple[StateField, ...]:
        rows = dim * (dim + 1) // 2
        meaning = "stress that relaxes, less what it follows, in the reference configuration: diagonal first"
        zero = (0.0,) * rows
        return tuple(
            StateField(f"Q_{k}", (rows,), zero, "Pa", f"{meaning} (branch {k})") for k in range(1, self.n_branches + 1)
        )

    def wave_modulus(self, theta: Array) -> Array:  # type: ignore[override]
        """Return 4/3 mu times the sum of the ratios [Pa], shape (n,)."""
        n = 2 * self.n_branches
        return np.asarray(4.0 / 3.0 * self._law.shear_modulus(theta[n:]) * theta[:n:2].sum(axis=0))


_EVERY = range(1, MOST + 1)


def in_motion(view: PronyKernel, dt: float) -> RelaxingKernel:
    """Return the view for substeps dt [s]."""
    theta, n = unpack(view.theta), len(view.branches)
    time = theta[1 : 2 * n : 2]
    a = np.exp(-0.5 * dt / np.where(time > 0.0, time, 1.0))  # columns between bodies have no times
    theta = pack(np.concatenate([theta, a]), view.theta.dtype)
    return RelaxingKernel(theta, view.rows + (0,) * n, (), view.branches, view.base)


def no_stress(term: Any, theta: Any, F: Any, C: Any) -> Any:
    """Return tau of branches at rest, which is zero."""
    return zeros_like_rows(F)


def no_stress_vjp(term: Any, theta: Any, F: Any, C: Any, tau_bar: Any) -> Any:
    """Return (theta_bar, F_bar, C_bar)."""
    return zeros_like_rows(theta), zeros_like_rows(F), zeros_like_rows(F)


# --- the law ----------------------------------------------------------------------------------------------------------


@register_jitable
def shape_stress(term: Any, theta: Any, F: Any) -> Any:
    """Return S, the law's second Piola-Kirchhoff stress without that of the volume, as rows."""
    J = det(F)
    tau = kirchhoff(term.base, theta, F, zeros_like_rows(F))
    tau = plus_diagonal(tau, -J * volume_slope(term.base, theta, J))
    K = scale(cofactor(F), 1.0 / J)  # F^-T
    return to_rows(mul(mul_at(K, tau), K))


@register_jitable
def shape_stress_both(term: Any, theta: Any, F: Any, S_bar: Any) -> Any:
    """Return (S, theta_bar, F_bar) for the cotangent of the rows of S."""
    J, zero = det(F), zeros_like_rows(F)
    pressure = volume_slope(term.base, theta, J)
    K, bar = scale(cofactor(F), 1.0 / J), from_rows_vjp(S_bar)
    tau_bar = mul_bt(mul(K, bar), K)
    law = kirchhoff_both(term.base, theta, F, zero, tau_bar)
    tau, tr = plus_diagonal(law[0], -J * pressure), trace(tau_bar)
    # S = K^T tau K with K = F^-T, dK = -K dF^T K
    K_bar = scale(mul(mul(tau, K), bar), 2.0)
    F_bar = scale(mul(K, mul_at(K_bar, K)), -1.0)
    by_volume, J_bar = volume_slope_vjp(term.base, theta, J, -tr * J)
    F_bar = add(add(F_bar, law[2]), scale(cofactor(F), J_bar - tr * pressure))
    return to_rows(mul(mul_at(K, tau), K)), add_rows(law[1], by_volume), F_bar


# --- branches: each gets its g, t and a, and its number k -------------------------------------------------------------


def weight(g: Any, time: Any, a: Any, k: int) -> Any:
    """Return the part of S in the stress of branch k."""
    return (g * a,)


def next_Q(g: Any, time: Any, a: Any, k: int, Q: Any, S: Any) -> Any:
    """Return the Q of branch k after a substep."""
    a2 = a * a
    return add_rows(scale_rows(branch(Q, k, S), a2), scale_rows(S, g * a * (a2 - 1.0)))


def bar_of_Q(g: Any, time: Any, a: Any, k: int, total_bar: Any, next_bar: Any) -> Any:
    """Return the cotangent of the Q of branch k before a substep."""
    return add_rows(scale_rows(branch(next_bar, k, total_bar), a * a), total_bar)


def bar_of_S(g: Any, time: Any, a: Any, k: int, total_bar: Any, next_bar: Any) -> Any:
    """Return the cotangent of S through branch k."""
    ga = g * a
    return add_rows(scale_rows(branch(next_bar, k, total_bar), ga * (a * a - 1.0)), scale_rows(total_bar, ga))


def bars_of_rows(g: Any, time: Any, a: Any, k: int, Q: Any, S: Any, dt: float, total_bar: Any, next_bar: Any) -> Any:
    """Return the cotangents of the ratio and of the time of branch k."""
    bar, a2 = branch(next_bar, k, S), a * a
    now, later, kept = dot_rows(total_bar, S), dot_rows(bar, S), dot_rows(bar, branch(Q, k, S))
    a_bar = g * (now + later * (3.0 * a2 - 1.0)) + kept * a * 2.0
    return a * (now + later * (a2 - 1.0)), a_bar * a * (0.5 * dt) / (time * time)


def at_rest(g: Any, time: Any, a: Any, k: int, S: Any) -> Any:
    """Return the Q of branch k after a long rest."""
    return scale_rows(S, g * a * -1.0)


def bar_of_S_at_rest(g: Any, time: Any, a: Any, k: int, h_bar: Any, like: Any) -> Any:
    """Return the cotangent of S through the Q of branch k after a long rest; `like` has as many rows as S."""
    return scale_rows(branch(h_bar, k, like), g * a * -1.0)


def bars_at_rest(g: Any, time: Any, a: Any, k: int, S: Any, dt: float, h_bar: Any) -> Any:
    """Return the cotangents of the ratio and of the time of branch k after a long rest."""
    along = dot_rows(branch(h_bar, k, S), S) * a
    return along * -1.0, g * along * (-0.5 * dt) / (time * time)


weights = in_branches(weight, "weights", "")
next_Qs = in_branches(next_Q, "next_Qs", "Q, S")
bars_of_Qs = in_branches(bar_of_Q, "bars_of_Qs", "total_bar, next_bar")
bars_of_S = in_branches(bar_of_S, "bars_of_S", "total_bar, next_bar")
bars_of_all_rows = in_branches(bars_of_rows, "bars_of_all_rows", "Q, S, dt, total_bar, next_bar")
all_at_rest = in_branches(at_rest, "all_at_rest", "S")
bars_of_S_at_rest = in_branches(bar_of_S_at_rest, "bars_of_S_at_rest", "h_bar, like")
all_bars_at_rest = in_branches(bars_at_rest, "all_bars_at_rest", "S, dt, h_bar")


# --- a substep in motion ----------------------------------------------------------------------------------------------


def stress(term: Any, theta: Any, F: Any, C: Any, h: Any, dt: float) -> Any:
    """Return (tau, h_next)."""
    law = law_rows(theta, term.branches)
    J, S = det(F), shape_stress(term, law, F)
    answer = from_rows(total(h, weights(theta, term.branches), S))
    tau = plus_diagonal(mul_bt(mul(F, answer), F), J * volume_slope(term.base, law, J))
    return tau, next_Qs(theta, term.branches, h, S)


def stress_both(term: Any, theta: Any, F: Any, C: Any, h: Any, dt: float, tau_bar: Any, h_next_bar: Any) -> Any:
    """Return (tau, theta_bar, F_bar, C_bar, h_bar)."""
    J, bar, tr, law = det(F), symmetric(tau_bar), trace(tau_bar), law_rows(theta, term.branches)
    total_bar = to_rows_vjp(mul(mul_at(F, bar), F))
    S_bar = add_rows(total_bar, summed(bars_of_S(theta, term.branches, total_bar, h_next_bar), total_bar))
    S, law_bar, F_bar = shape_stress_both(term, law, F, S_bar)
    answer, pressure = from_rows(total(h, weights(theta, term.branches), S)), volume_slope(term.base, law, J)
    by_volume, J_bar = volume_slope_vjp(term.base, law, J, tr * J)
    F_bar = add(F_bar, scale(mul(mul(bar, F), answer), 2.0))
    F_bar = add(F_bar, scale(cofactor(F), J_bar + tr * pressure))
    own = bars_of_all_rows(theta, term.branches, h, S, dt, total_bar, h_next_bar)
    theta_bar = all_rows(theta, own, add_rows(law_bar, by_volume))
    h_bar = bars_of_Qs(theta, term.branches, total_bar, h_next_bar)
    tau = plus_diagonal(mul_bt(mul(F, answer), F), J * pressure)
    return tau, theta_bar, F_bar, zeros_like_rows(F), h_bar


_both = register_jitable(stress_both)


def stress_vjp(term: Any, theta: Any, F: Any, C: Any, h: Any, dt: float, tau_bar: Any, h_next_bar: Any) -> Any:
    """Return (theta_bar, F_bar, C_bar, h_bar)."""
    found = _both(term, theta, F, C, h, dt, tau_bar, h_next_bar)
    return found[1], found[2], found[3], found[4]


# --- after a long rest ------------------------------------------------------------------------------------------------


def settled(term: Any, theta: Any, F: Any, dt: float) -> Any:
    """Return the Q of all branches, -g_i a_i S, where all H have faded."""
    return all_at_rest(theta, term.branches, shape_stress(term, law_rows(theta, term.branches), F))


def settled_vjp(term: Any, theta: Any, F: Any, dt: float, h_bar: Any) -> Any:
    """Return (theta_bar, F_bar)."""
    like = to_rows(F)
    S_bar = summed(bars_of_S_at_rest(theta, term.branches, h_bar, like), like)
    S, law_bar, F_bar = shape_stress_both(term, law_rows(theta, term.branches), F, S_bar)
    return all_rows(theta, all_bars_at_rest(theta, term.branches, S, dt, h_bar), law_bar), F_bar


register(PronyKernel, no_stress, no_stress_vjp, rate=False)
register_with_history(RelaxingKernel, stress, stress_vjp, rate=False, both=stress_both)
register_settled(RelaxingKernel, settled, settled_vjp)
register_in_motion(PronyKernel, RelaxingKernel, in_motion, holds_law=True)
