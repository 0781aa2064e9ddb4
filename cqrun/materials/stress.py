"""The stress of a material in a lane of particles, the sum of its terms, and the adjoint.

The elastic law is the first term. Where another one holds its stress (`term.register_in_motion`), it is left out.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from numba.extending import overload, register_jitable

from cqrun.materials.history import accumulate_history, load_history
from cqrun.materials.term import accumulate_rows, holds_law, kirchhoff, kirchhoff_both, kirchhoff_vjp, load_rows
from cqrun.numerics.tensor import add
from cqrun.plugin.contract import Array


def law_is_held(kernel_classes: Iterable[type]) -> bool:
    """Return whether one of these classes, but for the first, holds the stress of the first."""
    return any(map(holds_law, list(kernel_classes)[1:]))


def sum_of_stresses(terms: Any, q: Array, i: int, F: Any, C: Any) -> Any:
    """Return the sum of the Kirchhoff stresses of terms."""
    theta = load_rows(terms[0].theta, terms[0].rows, i)
    tau = kirchhoff(terms[0], theta, F, C, load_history(terms[0], q, i))
    return add(tau, sum_of_stresses(terms[1:], q, i, F, C)) if len(terms) > 1 else tau


@overload(sum_of_stresses)
def _sum_of_stresses(terms, q, i, F, C):
    def one(terms, q, i, F, C):
        theta = load_rows(terms[0].theta, terms[0].rows, i)
        return kirchhoff(terms[0], theta, F, C, load_history(terms[0], q, i))

    def several(terms, q, i, F, C):
        return add(one_of(terms, q, i, F, C), sum_of_stresses(terms[1:], q, i, F, C))

    one_of = register_jitable(one)
    return several if len(terms) > 1 else one


def sum_of_stresses_vjp(
    terms: Any, terms_bar: Any, q: Array, q_bar: Array, i: int, F: Any, C: Any, tau_bar: Any
) -> Any:
    """Return (F_bar, C_bar) of `sum_of_stresses`, and add to the cotangents of parameters and histories."""
    theta = load_rows(terms[0].theta, terms[0].rows, i)
    bars = kirchhoff_vjp(terms[0], theta, F, C, load_history(terms[0], q, i), tau_bar)
    accumulate_rows(terms_bar[0].theta, terms[0].rows, i, bars[0])
    accumulate_history(terms[0], q_bar, i, bars)
    if len(terms) == 1:
        return bars[1], bars[2]
    F_more, C_more = sum_of_stresses_vjp(terms[1:], terms_bar[1:], q, q_bar, i, F, C, tau_bar)
    return add(bars[1], F_more), add(bars[2], C_more)


@overload(sum_of_stresses_vjp)
def _sum_of_stresses_vjp(terms, terms_bar, q, q_bar, i, F, C, tau_bar):
    def one(terms, terms_bar, q, q_bar, i, F, C, tau_bar):
        theta = load_rows(terms[0].theta, terms[0].rows, i)
        bars = kirchhoff_vjp(terms[0], theta, F, C, load_history(terms[0], q, i), tau_bar)
        accumulate_rows(terms_bar[0].theta, terms[0].rows, i, bars[0])
        accumulate_history(terms[0], q_bar, i, bars)
        return bars[1], bars[2]

    def several(terms, terms_bar, q, q_bar, i, F, C, tau_bar):
        F_bar, C_bar = one_of(terms, terms_bar, q, q_bar, i, F, C, tau_bar)
        F_more, C_more = sum_of_stresses_vjp(terms[1:], terms_bar[1:], q, q_bar, i, F, C, tau_bar)
        return add(F_bar, F_more), add(C_bar, C_more)

    one_of = register_jitable(one)
    return several if len(terms) > 1 else one


def sum_of_stresses_both(
    terms: Any, terms_bar: Any, q: Array, q_bar: Array, i: int, F: Any, C: Any, tau_bar: Any
) -> Any:
    """Return (tau, F_bar, C_bar): `sum_of_stresses` and `sum_of_stresses_vjp` in one."""
    theta = load_rows(terms[0].theta, terms[0].rows, i)
    found = kirchhoff_both(terms[0], theta, F, C, load_history(terms[0], q, i), tau_bar)
    accumulate_rows(terms_bar[0].theta, terms[0].rows, i, found[1])
    accumulate_history(terms[0], q_bar, i, found[1:])
    if len(terms) == 1:
        return found[0], found[2], found[3]
    more = sum_of_stresses_both(terms[1:], terms_bar[1:], q, q_bar, i, F, C, tau_bar)
    return add(found[0], more[0]), add(found[2], more[1]), add(found[3], more[2])


@overload(sum_of_stresses_both)
def _sum_of_stresses_both(terms, terms_bar, q, q_bar, i, F, C, tau_bar):
    def one(terms, terms_bar, q, q_bar, i, F, C, tau_bar):
        theta = load_rows(terms[0].theta, terms[0].rows, i)
        found = kirchhoff_both(terms[0], theta, F, C, load_history(terms[0], q, i), tau_bar)
        accumulate_rows(terms_bar[0].theta, terms[0].rows, i, found[1])
        accumulate_history(terms[0], q_bar, i, found[1:])
        return found[0], found[2], found[3]

    def several(terms, terms_bar, q, q_bar, i, F, C, tau_bar):
        tau, F_bar, C_bar = one_of(terms, terms_bar, q, q_bar, i, F, C, tau_bar)
        more = sum_of_stresses_both(terms[1:], terms_bar[1:], q, q_bar, i, F, C, tau_bar)
        return add(tau, more[0]), add(F_bar, more[1]), add(C_bar, more[2])

    one_of = register_jitable(one)
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
def total_kirchhoff(terms: Any, q: Array, i: int, F: Any, C: Any) -> Any:
    """Return the sum of the Kirchhoff stresses of all terms for the lane of particles at i."""
    return sum_of_stresses(acting(terms, terms), q, i, F, C)


@register_jitable
def total_kirchhoff_vjp(
    terms: Any, terms_bar: Any, q: Array, q_bar: Array, i: int, F: Any, C: Any, tau_bar: Any
) -> Any:
    """Return (F_bar, C_bar); add to the cotangents of the parameters in terms_bar and of the histories in q_bar."""
    return sum_of_stresses_vjp(acting(terms, terms), acting(terms, terms_bar), q, q_bar, i, F, C, tau_bar)


@register_jitable
def total_kirchhoff_both(
    terms: Any, terms_bar: Any, q: Array, q_bar: Array, i: int, F: Any, C: Any, tau_bar: Any
) -> Any:
    """Return (tau, F_bar, C_bar): `total_kirchhoff` and `total_kirchhoff_vjp` in one."""
    return sum_of_stresses_both(acting(terms, terms), acting(terms, terms_bar), q, q_bar, i, F, C, tau_bar)


def stress_slope(terms: Any, q: Array, i: int, F: Any, C: Any, tau_bar: Any) -> Any:
    """Return the F_bar of `total_kirchhoff_vjp`, without the cotangents of the parameters."""
    theta = load_rows(terms[0].theta, terms[0].rows, i)
    F_bar = kirchhoff_vjp(terms[0], theta, F, C, load_history(terms[0], q, i), tau_bar)[1]
    return add(F_bar, stress_slope(terms[1:], q, i, F, C, tau_bar)) if len(terms) > 1 else F_bar


@overload(stress_slope)
def _stress_slope(terms, q, i, F, C, tau_bar):
    def one(terms, q, i, F, C, tau_bar):
        theta = load_rows(terms[0].theta, terms[0].rows, i)
        return kirchhoff_vjp(terms[0], theta, F, C, load_history(terms[0], q, i), tau_bar)[1]

    def several(terms, q, i, F, C, tau_bar):
        return add(one_of(terms, q, i, F, C, tau_bar), stress_slope(terms[1:], q, i, F, C, tau_bar))

    one_of = register_jitable(one)
    return several if len(terms) > 1 else one
