"""The stress of a material in a lane of particles, the sum of its terms, and the adjoint.

The elastic law is the first term. Where another one holds its stress (`term.register_in_motion`), it is left out.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from numba.extending import overload, register_jitable

from cqrun.materials.history import stress_of, stress_of_both, stress_of_vjp
from cqrun.materials.term import holds_law, kirchhoff_vjp, load_rows
from cqrun.numerics.tensor import add
from cqrun.plugin.contract import Array


def law_is_held(kernel_classes: Iterable[type]) -> bool:
    """Return whether one of these classes, but for the first, holds the stress of the first."""
    return any(map(holds_law, list(kernel_classes)[1:]))


def sum_of_stresses(terms: Any, q: Array, q_next: Array, i: int, F: Any, C: Any, dt: float) -> Any:
    """Return the sum of the Kirchhoff stresses of terms; write their histories to q_next."""
    tau = stress_of(terms[0], q, q_next, i, F, C, dt)
    return add(tau, sum_of_stresses(terms[1:], q, q_next, i, F, C, dt)) if len(terms) > 1 else tau


@overload(sum_of_stresses)
def _sum_of_stresses(terms, q, q_next, i, F, C, dt):
    def one(terms, q, q_next, i, F, C, dt):
        return stress_of(terms[0], q, q_next, i, F, C, dt)

    def several(terms, q, q_next, i, F, C, dt):
        tau = stress_of(terms[0], q, q_next, i, F, C, dt)
        return add(tau, sum_of_stresses(terms[1:], q, q_next, i, F, C, dt))

    return several if len(terms) > 1 else one


def sum_of_stresses_vjp(
    terms: Any, terms_bar: Any, q: Array, q_bar: Array, i: int, F: Any, C: Any, dt: float, tau_bar: Any
) -> Any:
    """Return (F_bar, C_bar) of `sum_of_stresses`; see `history.stress_of_vjp`."""
    F_bar, C_bar = stress_of_vjp(terms[0], terms_bar[0], q, q_bar, i, F, C, dt, tau_bar)
    if len(terms) == 1:
        return F_bar, C_bar
    F_more, C_more = sum_of_stresses_vjp(terms[1:], terms_bar[1:], q, q_bar, i, F, C, dt, tau_bar)
    return add(F_bar, F_more), add(C_bar, C_more)


@overload(sum_of_stresses_vjp)
def _sum_of_stresses_vjp(terms, terms_bar, q, q_bar, i, F, C, dt, tau_bar):
    def one(terms, terms_bar, q, q_bar, i, F, C, dt, tau_bar):
        return stress_of_vjp(terms[0], terms_bar[0], q, q_bar, i, F, C, dt, tau_bar)

    def several(terms, terms_bar, q, q_bar, i, F, C, dt, tau_bar):
        F_bar, C_bar = stress_of_vjp(terms[0], terms_bar[0], q, q_bar, i, F, C, dt, tau_bar)
        F_more, C_more = sum_of_stresses_vjp(terms[1:], terms_bar[1:], q, q_bar, i, F, C, dt, tau_bar)
        return add(F_bar, F_more), add(C_bar, C_more)

    return several if len(terms) > 1 else one


def sum_of_stresses_both(
    terms: Any, terms_bar: Any, q: Array, q_bar: Array, i: int, F: Any, C: Any, dt: float, tau_bar: Any
) -> Any:
    """Return (tau, F_bar, C_bar): `sum_of_stresses` and `sum_of_stresses_vjp` in one."""
    found = stress_of_both(terms[0], terms_bar[0], q, q_bar, i, F, C, dt, tau_bar)
    if len(terms) == 1:
        return found
    more = sum_of_stresses_both(terms[1:], terms_bar[1:], q, q_bar, i, F, C, dt, tau_bar)
    return add(found[0], more[0]), add(found[1], more[1]), add(found[2], more[2])


@overload(sum_of_stresses_both)
def _sum_of_stresses_both(terms, terms_bar, q, q_bar, i, F, C, dt, tau_bar):
    def one(terms, terms_bar, q, q_bar, i, F, C, dt, tau_bar):
        return stress_of_both(terms[0], terms_bar[0], q, q_bar, i, F, C, dt, tau_bar)

    def several(terms, terms_bar, q, q_bar, i, F, C, dt, tau_bar):
        tau, F_bar, C_bar = stress_of_both(terms[0], terms_bar[0], q, q_bar, i, F, C, dt, tau_bar)
        more = sum_of_stresses_both(terms[1:], terms_bar[1:], q, q_bar, i, F, C, dt, tau_bar)
        return add(tau, more[0]), add(F_bar, more[1]), add(C_bar, more[2])

    return several if len(terms) > 1 else one


def acting(terms: Any, parts: Any) -> Any:
    """Return the parts, one for each term, of the terms that act: all but a law whose stress another term holds."""
    return parts[1:] if law_is_held(type(term) for term in terms) else parts


@overload(acting)
def _acting(terms, parts):
    def but_the_law(terms, parts):
        return parts[1:]

    def every(terms, parts):
        return parts

    return but_the_law if law_is_held(term.instance_class for term in terms) else every


@register_jitable
def total_kirchhoff(terms: Any, q: Array, q_next: Array, i: int, F: Any, C: Any, dt: float) -> Any:
    """Return the sum of the Kirchhoff stresses of all terms for the lane of particles at i.

    Histories after the substep dt [s] are written to q_next, which may be q.
    """
    return sum_of_stresses(acting(terms, terms), q, q_next, i, F, C, dt)


@register_jitable
def total_kirchhoff_vjp(
    terms: Any, terms_bar: Any, q: Array, q_bar: Array, i: int, F: Any, C: Any, dt: float, tau_bar: Any
) -> Any:
    """Return (F_bar, C_bar), and add to the cotangents of the parameters in terms_bar.

    The cotangents of the histories in q_bar become those at the substep's beginning.
    """
    return sum_of_stresses_vjp(acting(terms, terms), acting(terms, terms_bar), q, q_bar, i, F, C, dt, tau_bar)


@register_jitable
def total_kirchhoff_both(
    terms: Any, terms_bar: Any, q: Array, q_bar: Array, i: int, F: Any, C: Any, dt: float, tau_bar: Any
) -> Any:
    """Return (tau, F_bar, C_bar): `total_kirchhoff` and `total_kirchhoff_vjp` in one; q is not written."""
    return sum_of_stresses_both(acting(terms, terms), acting(terms, terms_bar), q, q_bar, i, F, C, dt, tau_bar)


def stress_slope(terms: Any, i: int, F: Any, C: Any, tau_bar: Any) -> Any:
    """Return the F_bar of `total_kirchhoff_vjp` at rest, without the cotangents of the parameters."""
    theta = load_rows(terms[0].theta, terms[0].rows, i)
    F_bar = kirchhoff_vjp(terms[0], theta, F, C, tau_bar)[1]
    return add(F_bar, stress_slope(terms[1:], i, F, C, tau_bar)) if len(terms) > 1 else F_bar


@overload(stress_slope)
def _stress_slope(terms, i, F, C, tau_bar):
    def one(terms, i, F, C, tau_bar):
        theta = load_rows(terms[0].theta, terms[0].rows, i)
        return kirchhoff_vjp(terms[0], theta, F, C, tau_bar)[1]

    def several(terms, i, F, C, tau_bar):
        return add(one_of(terms, i, F, C, tau_bar), stress_slope(terms[1:], i, F, C, tau_bar))

    one_of = register_jitable(one)
    return several if len(terms) > 1 else one
