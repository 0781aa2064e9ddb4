"""The law of contact at one point, and its adjoint: a penalty along the normal, a tangential spring for friction.

At depth h > 0 below a surface with unit normal n, at the relative velocity v (h' = -v . n),

    N = max(0, K h + C h' h / (h + h0))                              pushes along n
    s' = the tangential part of s + dt v, shortened to mu N / K      pulls with -K s'

with the spring s from the last substep. A spring within the bound sticks, a shortened one slides (Coulomb). The dashpot
begins at zero depth with zero, so that forces are continuous; where there is no force, s' = 0.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cqrun.boundaries.solid import ZERO
from cqrun.numerics.compile import kernel
from cqrun.numerics.tensor import add, dot, scale, sub

ONSET = 1e-2
"""h0: depth at which half of the dashpot acts [cells]."""


@kernel
def push(K: float, C: float, h0: float, h: float, rate: float) -> float:
    """Return N for a depth h > 0 and its rate."""
    return max(0.0, K * h + C * rate * h / (h + h0))


@kernel
def push_vjp(K: float, C: float, h0: float, h: float, rate: float, N_bar: float) -> Any:
    """Return (h_bar, rate_bar); N is positive."""
    return N_bar * (K + C * rate * h0 / (h + h0) ** 2), N_bar * C * h / (h + h0)


@kernel
def tangential(a: Any, n: Any) -> Any:
    """Return the part of a that is normal to n."""
    return sub(a, scale(n, dot(a, n)))


@kernel
def rub(K: float, mu: float, N: float, dt: float, n: Any, v: Any, spring: Any) -> Any:
    """Return s'."""
    s = tangential(add(spring, scale(v, dt)), n)
    length = np.sqrt(dot(s, s))
    if K * length < mu * N:
        return s
    return scale(s, mu * N / (K * length)) if length > 0.0 else ZERO


@kernel
def rub_vjp(K: float, mu: float, N: float, dt: float, n: Any, v: Any, spring: Any, out_bar: Any) -> Any:
    """Return (mu_bar, N_bar, n_bar, v_bar, spring_bar) from the cotangent of s'."""
    a = add(spring, scale(v, dt))
    s = tangential(a, n)
    length, mu_bar, N_bar, s_bar = np.sqrt(dot(s, s)), 0.0, 0.0, out_bar
    if not K * length < mu * N:
        if length == 0.0:
            return 0.0, 0.0, ZERO, ZERO, ZERO
        e = scale(s, 1.0 / length)
        along = dot(e, out_bar)
        mu_bar, N_bar = along * N / K, along * mu / K
        s_bar = scale(sub(out_bar, scale(e, along)), mu * N / (K * length))
    n_bar = add(scale(s_bar, -dot(n, a)), scale(a, -dot(n, s_bar)))
    a_bar = tangential(s_bar, n)
    return mu_bar, N_bar, n_bar, scale(a_bar, dt), a_bar


@kernel
def meet(K: float, C: float, h0: float, mu: float, dt: float, h: float, n: Any, v: Any, spring: Any) -> Any:
    """Return the force and s' of one contact at a depth h > 0; both are zero if N is."""
    N = push(K, C, h0, h, -dot(n, v))
    if not N > 0.0:
        return ZERO, ZERO
    after = rub(K, mu, N, dt, n, v, spring)
    return sub(scale(n, N), scale(after, K)), after


@kernel
def meet_vjp(
    K: float, C: float, h0: float, mu: float, dt: float, h: float, n: Any, v: Any, spring: Any, force_bar: Any,
    after_bar: Any,
) -> Any:  # fmt: skip
    """Return (mu_bar, h_bar, n_bar, v_bar, spring_bar)."""
    rate = -dot(n, v)
    N = push(K, C, h0, h, rate)
    if not N > 0.0:
        return 0.0, 0.0, ZERO, ZERO, ZERO
    out_bar = sub(after_bar, scale(force_bar, K))
    mu_bar, N_bar, n_bar, v_bar, spring_bar = rub_vjp(K, mu, N, dt, n, v, spring, out_bar)
    N_bar, n_bar = N_bar + dot(n, force_bar), add(n_bar, scale(force_bar, N))
    h_bar, rate_bar = push_vjp(K, C, h0, h, rate, N_bar)
    n_bar, v_bar = sub(n_bar, scale(v, rate_bar)), sub(v_bar, scale(n, rate_bar))
    return mu_bar, h_bar, n_bar, v_bar, spring_bar
