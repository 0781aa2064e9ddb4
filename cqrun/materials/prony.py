"""A stress that relaxes: Simo's finite linear viscoelasticity, as finite-element programs have it.

The elastic law is the material's answer after a long time. Each branch i, with a ratio g_i and a time t_i, adds a
stress H_i that follows the changes of S, the law's second Piola-Kirchhoff stress without that of the volume, and fades:

    tau = F (sum_i H_i) F^T,   H_i' = exp(-dt/t_i) H_i + g_i exp(-dt/(2 t_i)) (S(F') - S(F)),

    S = F^-1 (tau_elastic - J U'(J) I) F^-T

(Simo, Comput. Methods Appl. Mech. Eng. 60, 1987; Simo and Hughes, Computational Inelasticity, 1998, section 10.3). H is
symmetric, in the reference configuration, and zero at rest. At once the material is 1 + sum_i g_i times as stiff. H is
linear in its past, so its adjoint is short. S is kept beside H, so that the law is evaluated once in a substep:
in motions, tau is F (S + sum_i H_i) F^T + J U'(J) I.
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
    no_rows,
    repeated,
    scale_rows,
    summed,
    with_law,
)
from cqrun.materials.term import (
    MaterialTerm,
    add_rows,
    kirchhoff,
    kirchhoff_vjp,
    register_in_motion,
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
    """Kernels' view: rows g_1, t_1 [s], ..., then those of the elastic law, whose view is `base`.

    `branches` has an entry for each branch, and `history` the rows of all H and then of S.
    """

    theta: Array
    rows: tuple[int, ...]
    history: tuple[int, ...]
    branches: tuple[int, ...]
    base: Any


class RelaxingKernel(NamedTuple):
    """The view in motions, whose stress is that of the law, too: theta ends with rows exp(-dt/(2 t_i))."""

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
    on the volume alone does not relax. The state of a particle grows by 6 numbers, and by 6 more for each branch (2D:
    by 3 and 3).
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
        return PronyKernel(theta, (0,) * len(self.parameters), (), (0,) * n, self._law.kernel_term(theta))

    def history(self, dim: int) -> tuple[StateField, ...]:
        rows = dim * (dim + 1) // 2
        meaning = "stress that relaxes, in the reference configuration: diagonal first"
        zero = (0.0,) * rows
        branches = (
            StateField(f"H_{k}", (rows,), zero, "Pa", f"{meaning} (branch {k})") for k in range(1, self.n_branches + 1)
        )
        law = "what the law answers to the shape, in the reference configuration: diagonal first"
        return *branches, StateField("S", (rows,), zero, "Pa", law, follows=True)

    def wave_modulus(self, theta: Array) -> Array:  # type: ignore[override]
        """Return 4/3 mu times the sum of the ratios [Pa], shape (n,)."""
        n = 2 * self.n_branches
        return np.asarray(4.0 / 3.0 * self._law.shear_modulus(theta[n:]) * theta[:n:2].sum(axis=0))


_EVERY = range(1, MOST + 1)


def in_motion(view: PronyKernel, dt: float) -> RelaxingKernel:
    """Return the view for substeps dt [s]."""
    theta, n = unpack(view.theta), len(view.branches)
    time = theta[1 : 2 * n : 2]
    half = np.exp(-0.5 * dt / np.where(time > 0.0, time, 1.0))  # columns between bodies have no times
    theta = pack(np.concatenate([theta, half]), view.theta.dtype)
    return RelaxingKernel(theta, view.rows + (0,) * n, *view[2:])


# --- stress -----------------------------------------------------------------------------------------------------------


def stress(term: Any, theta: Any, F: Any, C: Any, h: Any) -> Any:
    """Return tau."""
    return mul_bt(mul(F, from_rows(summed(h, term.branches))), F)


def stress_vjp(term: Any, theta: Any, F: Any, C: Any, h: Any, tau_bar: Any) -> Any:
    """Return (theta_bar, F_bar, C_bar, h_bar)."""
    H, bar = from_rows(summed(h, term.branches)), symmetric(tau_bar)
    H_bar = mul(mul_at(F, bar), F)
    F_bar = scale(mul(mul(bar, F), H), 2.0)
    H_bar = to_rows_vjp(H_bar)
    return zeros_like_rows(theta), F_bar, zeros_like_rows(F), repeated(H_bar, term.branches, zeros_like_rows(H_bar))


def stress_in_motion(term: Any, theta: Any, F: Any, C: Any, h: Any) -> Any:
    """Return tau with that of the law, J U'(J) I + F (S + sum_i H_i) F^T."""
    J, answer = det(F), from_rows(with_law(h, term.branches))
    pressure = volume_slope(term.base, law_rows(theta, term.branches), J)
    return plus_diagonal(mul_bt(mul(F, answer), F), J * pressure)


def stress_in_motion_vjp(term: Any, theta: Any, F: Any, C: Any, h: Any, tau_bar: Any) -> Any:
    """Return (theta_bar, F_bar, C_bar, h_bar)."""
    J, answer, bar = det(F), from_rows(with_law(h, term.branches)), symmetric(tau_bar)
    law, tr = law_rows(theta, term.branches), trace(tau_bar)
    law_bar, J_bar = volume_slope_vjp(term.base, law, J, tr * J)
    J_bar = J_bar + tr * volume_slope(term.base, law, J)
    F_bar = add(scale(mul(mul(bar, F), answer), 2.0), scale(cofactor(F), J_bar))
    answer_bar = to_rows_vjp(mul(mul_at(F, bar), F))
    theta_bar = all_rows(theta, no_rows(theta, term.branches), law_bar)
    return theta_bar, F_bar, zeros_like_rows(F), repeated(answer_bar, term.branches, answer_bar)


# --- the history ------------------------------------------------------------------------------------------------------


@register_jitable
def shape_stress(term: Any, theta: Any, F: Any) -> Any:
    """Return S, the law's second Piola-Kirchhoff stress without that of the volume, as rows."""
    J = det(F)
    tau = kirchhoff(term.base, theta, F, zeros_like_rows(F), ())
    tau = plus_diagonal(tau, -J * volume_slope(term.base, theta, J))
    K = scale(cofactor(F), 1.0 / J)  # F^-T
    return to_rows(mul(mul_at(K, tau), K))


@register_jitable
def shape_stress_vjp(term: Any, theta: Any, F: Any, S_bar: Any) -> Any:
    """Return (theta_bar, F_bar) for the cotangent of the rows of S."""
    J, zero = det(F), zeros_like_rows(F)
    pressure = volume_slope(term.base, theta, J)
    tau = plus_diagonal(kirchhoff(term.base, theta, F, zero, ()), -J * pressure)
    K, bar = scale(cofactor(F), 1.0 / J), from_rows_vjp(S_bar)
    tau_bar = mul_bt(mul(K, bar), K)
    # S = K^T tau K with K = F^-T, dK = -K dF^T K
    K_bar = scale(mul(mul(tau, K), bar), 2.0)
    F_bar = scale(mul(K, mul_at(K_bar, K)), -1.0)
    by_law, tr = kirchhoff_vjp(term.base, theta, F, zero, (), tau_bar), trace(tau_bar)
    by_volume, J_bar = volume_slope_vjp(term.base, theta, J, -tr * J)
    F_bar = add(add(F_bar, by_law[1]), scale(cofactor(F), J_bar - tr * pressure))
    return add_rows(by_law[0], by_volume), F_bar


def branch_update(ratio: Any, time: Any, half: Any, k: int, h: Any, change: Any) -> Any:
    """Return H of branch k after a substep in which S changes."""
    return add_rows(scale_rows(branch(h, k, change), half * half), scale_rows(change, ratio * half))


def branch_vjp(ratio: Any, time: Any, half: Any, k: int, h: Any, change: Any, dt: Any, bars: Any) -> Any:
    """Return the cotangents of the ratio and of the time of branch k."""
    bar = branch(bars, k, change)
    along, faded = dot_rows(bar, change) * half, dot_rows(bar, branch(h, k, change)) * half * half
    return along, (faded + 0.5 * ratio * along) * dt / (time * time)


def branch_fades(ratio: Any, time: Any, half: Any, k: int, change: Any, bars: Any) -> Any:
    """Return the cotangent of H of branch k before the substep."""
    return scale_rows(branch(bars, k, change), half * half)


def branch_pulls(ratio: Any, time: Any, half: Any, k: int, change: Any, bars: Any) -> Any:
    """Return the cotangent of the change of S through branch k."""
    return scale_rows(branch(bars, k, change), ratio * half)


updates = in_branches(branch_update, "updates", "h, change")
branches_vjp = in_branches(branch_vjp, "branches_vjp", "h, change, dt, bars")
fades = in_branches(branch_fades, "fades", "change, bars")
pulls = in_branches(branch_pulls, "pulls", "change, bars")


def update(term: Any, theta: Any, F: Any, h: Any, dt: Any) -> Any:
    """Return h after a substep that ends at F."""
    S = shape_stress(term, law_rows(theta, term.branches), F)
    change = add_rows(S, scale_rows(branch(h, len(term.branches), S), -1.0))
    return updates(theta, term.branches, h, change) + S


def update_vjp(term: Any, theta: Any, F: Any, h: Any, dt: Any, h_next_bar: Any) -> Any:
    """Return (theta_bar, F_bar, h_bar)."""
    law, last = law_rows(theta, term.branches), len(term.branches)
    S = shape_stress(term, law, F)
    change = add_rows(S, scale_rows(branch(h, last, S), -1.0))
    change_bar = summed(pulls(theta, term.branches, change, h_next_bar) + S, term.branches)  # S is not summed
    law_bar, F_bar = shape_stress_vjp(term, law, F, add_rows(change_bar, branch(h_next_bar, last, S)))
    theta_bar = all_rows(theta, branches_vjp(theta, term.branches, h, change, dt, h_next_bar), law_bar)
    return theta_bar, F_bar, fades(theta, term.branches, change, h_next_bar) + scale_rows(change_bar, -1.0)


register_with_history(PronyKernel, stress, stress_vjp, rate=False)
register_with_history(RelaxingKernel, stress_in_motion, stress_in_motion_vjp, update, update_vjp, rate=False)
register_in_motion(PronyKernel, RelaxingKernel, in_motion)
