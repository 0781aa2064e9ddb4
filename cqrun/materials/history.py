"""The stress of one term in a lane of particles, with its history if it has one, and the adjoints.

A history is a set of rows of the state q; a term's kernel class names them in its field `history`. A substep's stress
also gives the history at the substep's end, which is written to q_next; q_next may be q. The adjoint replaces the
history's cotangent in q_bar by that of the substep's beginning.

The classes of the terms select these functions at compile time, so kernels of a material without history contain
nothing of it.
"""

from __future__ import annotations

from typing import Any

from numba.extending import overload

from cqrun.materials.term import (
    accumulate_rows,
    has_history,
    kirchhoff,
    kirchhoff_both,
    kirchhoff_vjp,
    load_rows,
    settled,
    settled_vjp,
    stress_and_history,
    stress_and_history_both,
    stress_and_history_vjp,
    written_tuple,
)
from cqrun.numerics.compile import written
from cqrun.numerics.packed import load, store
from cqrun.numerics.tensor import add
from cqrun.plugin.contract import Array


def load_history(term: Any, q: Array, i: int) -> Any:
    """Return the lane values of a term's history as a tuple."""
    return tuple(load(q, row, i) for row in term.history)


def store_history(term: Any, q: Array, i: int, values: Any) -> None:
    """Write the lane values of a term's history."""
    for row, value in zip(term.history, values, strict=True):
        store(q, row, i, value)


def _n_rows(term: Any) -> int:
    """Return the number of rows of a history, for the Numba type of the term."""
    return len(term.types[term.fields.index("history")])


@overload(load_history)
def _load_history(term, q, i):
    return written(
        "lambda term, q, i: " + written_tuple("load(q, term.history[{r}], i)", _n_rows(term)), {"load": load}
    )


@overload(store_history)
def _store_history(term, q, i, values):
    entries = written_tuple("store(q, term.history[{r}], i, values[{r}])", _n_rows(term))
    return written(f"lambda term, q, i, values: {entries}", {"store": store})


# --- a substep of one term ------------------------------------------------------------------------------------


def stress_of(term: Any, q: Array, q_next: Array, i: int, F: Any, C: Any, dt: float) -> Any:
    """Return the Kirchhoff stress of a term; write its history after the substep to q_next."""
    theta = load_rows(term.theta, term.rows, i)
    if not has_history(type(term)):
        return kirchhoff(term, theta, F, C)
    tau, h_next = stress_and_history(term, theta, F, C, load_history(term, q, i), dt)
    store_history(term, q_next, i, h_next)
    return tau


@overload(stress_of)
def _stress_of(term, q, q_next, i, F, C, dt):
    def plain(term, q, q_next, i, F, C, dt):
        return kirchhoff(term, load_rows(term.theta, term.rows, i), F, C)

    def remembering(term, q, q_next, i, F, C, dt):
        theta = load_rows(term.theta, term.rows, i)
        tau, h_next = stress_and_history(term, theta, F, C, load_history(term, q, i), dt)
        store_history(term, q_next, i, h_next)
        return tau

    return remembering if has_history(term.instance_class) else plain


def stress_of_vjp(
    term: Any, term_bar: Any, q: Array, q_bar: Array, i: int, F: Any, C: Any, dt: float, tau_bar: Any
) -> Any:
    """Return (F_bar, C_bar) of `stress_of`; add to the cotangents of parameters."""
    theta = load_rows(term.theta, term.rows, i)
    if has_history(type(term)):
        h, h_bar = load_history(term, q, i), load_history(term, q_bar, i)
        bars = stress_and_history_vjp(term, theta, F, C, h, dt, tau_bar, h_bar)
        store_history(term, q_bar, i, bars[3])
    else:
        bars = kirchhoff_vjp(term, theta, F, C, tau_bar)
    accumulate_rows(term_bar.theta, term.rows, i, bars[0])
    return bars[1], bars[2]


@overload(stress_of_vjp)
def _stress_of_vjp(term, term_bar, q, q_bar, i, F, C, dt, tau_bar):
    def plain(term, term_bar, q, q_bar, i, F, C, dt, tau_bar):
        bars = kirchhoff_vjp(term, load_rows(term.theta, term.rows, i), F, C, tau_bar)
        accumulate_rows(term_bar.theta, term.rows, i, bars[0])
        return bars[1], bars[2]

    def remembering(term, term_bar, q, q_bar, i, F, C, dt, tau_bar):
        theta = load_rows(term.theta, term.rows, i)
        h, h_bar = load_history(term, q, i), load_history(term, q_bar, i)
        bars = stress_and_history_vjp(term, theta, F, C, h, dt, tau_bar, h_bar)
        store_history(term, q_bar, i, bars[3])
        accumulate_rows(term_bar.theta, term.rows, i, bars[0])
        return bars[1], bars[2]

    return remembering if has_history(term.instance_class) else plain


def stress_of_both(
    term: Any, term_bar: Any, q: Array, q_bar: Array, i: int, F: Any, C: Any, dt: float, tau_bar: Any
) -> Any:
    """Return (tau, F_bar, C_bar): `stress_of`, which writes no history, and `stress_of_vjp` in one."""
    theta = load_rows(term.theta, term.rows, i)
    if has_history(type(term)):
        h, h_bar = load_history(term, q, i), load_history(term, q_bar, i)
        found = stress_and_history_both(term, theta, F, C, h, dt, tau_bar, h_bar)
        store_history(term, q_bar, i, found[4])
    else:
        found = kirchhoff_both(term, theta, F, C, tau_bar)
    accumulate_rows(term_bar.theta, term.rows, i, found[1])
    return found[0], found[2], found[3]


@overload(stress_of_both)
def _stress_of_both(term, term_bar, q, q_bar, i, F, C, dt, tau_bar):
    def plain(term, term_bar, q, q_bar, i, F, C, dt, tau_bar):
        found = kirchhoff_both(term, load_rows(term.theta, term.rows, i), F, C, tau_bar)
        accumulate_rows(term_bar.theta, term.rows, i, found[1])
        return found[0], found[2], found[3]

    def remembering(term, term_bar, q, q_bar, i, F, C, dt, tau_bar):
        theta = load_rows(term.theta, term.rows, i)
        h, h_bar = load_history(term, q, i), load_history(term, q_bar, i)
        found = stress_and_history_both(term, theta, F, C, h, dt, tau_bar, h_bar)
        store_history(term, q_bar, i, found[4])
        accumulate_rows(term_bar.theta, term.rows, i, found[1])
        return found[0], found[2], found[3]

    return remembering if has_history(term.instance_class) else plain


# --- after a long rest, all terms of a material ---------------------------------------------------------------


def settle_histories(terms: Any, q: Array, i: int, F: Any, dt: float) -> None:
    """Write the histories that terms have where they have rested at F for long."""
    for term in terms:
        if has_history(type(term)):
            store_history(term, q, i, settled(term, load_rows(term.theta, term.rows, i), F, dt))


@overload(settle_histories)
def _settle_histories(terms, q, i, F, dt):
    def none(terms, q, i, F, dt):
        pass

    def rest(terms, q, i, F, dt):
        settle_histories(terms[1:], q, i, F, dt)

    def several(terms, q, i, F, dt):
        theta = load_rows(terms[0].theta, terms[0].rows, i)
        store_history(terms[0], q, i, settled(terms[0], theta, F, dt))
        settle_histories(terms[1:], q, i, F, dt)

    return none if len(terms) == 0 else several if has_history(terms[0].instance_class) else rest


def settle_histories_vjp(terms: Any, terms_bar: Any, q_bar: Array, i: int, F: Any, dt: float, F_bar: Any) -> Any:
    """Return F_bar with what the histories give, and add to the cotangents of the parameters."""
    for term, term_bar in zip(terms, terms_bar, strict=True):
        if has_history(type(term)):
            theta = load_rows(term.theta, term.rows, i)
            bars = settled_vjp(term, theta, F, dt, load_history(term, q_bar, i))
            accumulate_rows(term_bar.theta, term.rows, i, bars[0])
            F_bar = add(F_bar, bars[1])
    return F_bar


@overload(settle_histories_vjp)
def _settle_histories_vjp(terms, terms_bar, q_bar, i, F, dt, F_bar):
    def none(terms, terms_bar, q_bar, i, F, dt, F_bar):
        return F_bar

    def rest(terms, terms_bar, q_bar, i, F, dt, F_bar):
        return settle_histories_vjp(terms[1:], terms_bar[1:], q_bar, i, F, dt, F_bar)

    def several(terms, terms_bar, q_bar, i, F, dt, F_bar):
        theta = load_rows(terms[0].theta, terms[0].rows, i)
        bars = settled_vjp(terms[0], theta, F, dt, load_history(terms[0], q_bar, i))
        accumulate_rows(terms_bar[0].theta, terms[0].rows, i, bars[0])
        return settle_histories_vjp(terms[1:], terms_bar[1:], q_bar, i, F, dt, add(F_bar, bars[1]))

    return none if len(terms) == 0 else several if has_history(terms[0].instance_class) else rest
