"""Read, update and write the histories of a material's terms in a lane of particles, and the adjoints.

A history is a set of rows of the state q; a term's kernel class names them in its field `history`. The classes of the
terms select these functions at compile time, so kernels of a material without history contain none of this code.
"""

from __future__ import annotations

from typing import Any

from numba.extending import overload

from cqrun.materials.term import accumulate_rows, has_history, load_rows, update, update_vjp, written_tuple
from cqrun.numerics.compile import written
from cqrun.numerics.packed import accumulate, load, store
from cqrun.numerics.tensor import add
from cqrun.plugin.contract import Array


def load_history(term: Any, q: Array, i: int) -> Any:
    """Return the lane values of a term's history as a tuple; empty for a term without history."""
    return tuple(load(q, row, i) for row in term.history) if has_history(type(term)) else ()


def store_history(term: Any, q: Array, i: int, values: Any) -> None:
    """Write the lane values of a term's history."""
    for row, value in zip(term.history, values, strict=True):
        store(q, row, i, value)


def accumulate_history(term: Any, q_bar: Array, i: int, bars: Any) -> None:
    """Add the last of a stress's cotangents to that of the term's history, if there is one."""
    if has_history(type(term)):
        for row, value in zip(term.history, bars[3], strict=True):
            accumulate(q_bar, row, i, value)


def _n_rows(term: Any) -> int:
    """Return the number of rows of a history, for the Numba type of the term."""
    return len(term.types[term.fields.index("history")])


@overload(load_history)
def _load_history(term, q, i):
    if not has_history(term.instance_class):
        return lambda term, q, i: ()
    return written(
        "lambda term, q, i: " + written_tuple("load(q, term.history[{r}], i)", _n_rows(term)), {"load": load}
    )


@overload(store_history)
def _store_history(term, q, i, values):
    entries = written_tuple("store(q, term.history[{r}], i, values[{r}])", _n_rows(term))
    return written(f"lambda term, q, i, values: {entries}", {"store": store})


@overload(accumulate_history)
def _accumulate_history(term, q_bar, i, bars):
    if not has_history(term.instance_class):
        return lambda term, q_bar, i, bars: None
    entries = written_tuple("accumulate(q_bar, term.history[{r}], i, bars[3][{r}])", _n_rows(term))
    return written(f"lambda term, q_bar, i, bars: {entries}", {"accumulate": accumulate})


# --- a substep, all terms of a material ----------------------------------------------------------------------


def update_histories(terms: Any, q: Array, q_next: Array, i: int, F: Any, dt: float) -> None:
    """Write the histories of all terms after a substep that ends at F; q_next may be q."""
    for term in terms:
        if has_history(type(term)):
            theta, h = load_rows(term.theta, term.rows, i), load_history(term, q, i)
            store_history(term, q_next, i, update(term, theta, F, h, dt))


@overload(update_histories)
def _update_histories(terms, q, q_next, i, F, dt):
    if not any(has_history(term.instance_class) for term in terms):
        return lambda terms, q, q_next, i, F, dt: None
    if not has_history(terms[0].instance_class):
        return lambda terms, q, q_next, i, F, dt: update_histories(terms[1:], q, q_next, i, F, dt)

    def several(terms, q, q_next, i, F, dt):
        theta, h = load_rows(terms[0].theta, terms[0].rows, i), load_history(terms[0], q, i)
        store_history(terms[0], q_next, i, update(terms[0], theta, F, h, dt))
        update_histories(terms[1:], q, q_next, i, F, dt)

    return several


def update_histories_vjp(
    terms: Any, terms_bar: Any, q: Array, q_bar: Array, i: int, F: Any, dt: float, F_bar: Any
) -> Any:
    """Return F_bar with the parts of the histories.

    In q_bar, replace the cotangents of the histories after the substep by those before it; add to those of the
    parameters.
    """
    for term, term_bar in zip(terms, terms_bar, strict=True):
        if has_history(type(term)):
            theta, h = load_rows(term.theta, term.rows, i), load_history(term, q, i)
            bars = update_vjp(term, theta, F, h, dt, load_history(term, q_bar, i))
            accumulate_rows(term_bar.theta, term.rows, i, bars[0])
            store_history(term, q_bar, i, bars[2])
            F_bar = add(F_bar, bars[1])
    return F_bar


@overload(update_histories_vjp)
def _update_histories_vjp(terms, terms_bar, q, q_bar, i, F, dt, F_bar):
    if not any(has_history(term.instance_class) for term in terms):
        return lambda terms, terms_bar, q, q_bar, i, F, dt, F_bar: F_bar

    def none(terms, terms_bar, q, q_bar, i, F, dt, F_bar):
        return update_histories_vjp(terms[1:], terms_bar[1:], q, q_bar, i, F, dt, F_bar)

    def several(terms, terms_bar, q, q_bar, i, F, dt, F_bar):
        theta, h = load_rows(terms[0].theta, terms[0].rows, i), load_history(terms[0], q, i)
        bars = update_vjp(terms[0], theta, F, h, dt, load_history(terms[0], q_bar, i))
        accumulate_rows(terms_bar[0].theta, terms[0].rows, i, bars[0])
        store_history(terms[0], q_bar, i, bars[2])
        return update_histories_vjp(terms[1:], terms_bar[1:], q, q_bar, i, F, dt, add(F_bar, bars[1]))

    return several if has_history(terms[0].instance_class) else none
