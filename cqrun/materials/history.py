"""The histories of a material's terms in a lane of particles: read, carried over a substep, and back.

A history is some rows of the state q, which a term's kernel class names in its field `history`. Kernels of a material
without history hold none of this code: every function here is chosen by the terms' classes when they are compiled.
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
    """Return the lane values of a term's history, a tuple; empty for a term without one."""
    return tuple(load(q, row, i) for row in term.history) if has_history(type(term)) else ()


def store_history(term: Any, q: Array, i: int, values: Any) -> None:
    """Write the lane values of a term's history."""
    for row, value in zip(term.history, values, strict=True):
        store(q, row, i, value)


def accumulate_history(term: Any, q_bar: Array, i: int, bars: Any) -> None:
    """Add the last of a stress's cotangents to that of the term's history, if it has one."""
    if has_history(type(term)):
        for row, value in zip(term.history, bars[3], strict=True):
            accumulate(q_bar, row, i, value)


def _n_rows(term: Any) -> int:
    """Return how many rows the history of a kernel class has, given its Numba type."""
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


# --- over a substep, all terms of a material -----------------------------------------------------------------


def update_histories(terms: Any, q: Array, q_next: Array, i: int, F: Any, F_next: Any, dt: float) -> None:
    """Write the histories of all terms after a substep that takes F to F_next; q_next may be q."""
    for term in terms:
        if has_history(type(term)):
            theta, h = load_rows(term.theta, term.rows, i), load_history(term, q, i)
            store_history(term, q_next, i, update(term, theta, F, F_next, h, dt))


@overload(update_histories)
def _update_histories(terms, q, q_next, i, F, F_next, dt):
    if len(terms) == 0:
        return lambda terms, q, q_next, i, F, F_next, dt: None
    if not has_history(terms[0].instance_class):
        return lambda terms, q, q_next, i, F, F_next, dt: update_histories(terms[1:], q, q_next, i, F, F_next, dt)

    def several(terms, q, q_next, i, F, F_next, dt):
        theta, h = load_rows(terms[0].theta, terms[0].rows, i), load_history(terms[0], q, i)
        store_history(terms[0], q_next, i, update(terms[0], theta, F, F_next, h, dt))
        update_histories(terms[1:], q, q_next, i, F, F_next, dt)

    return several


def update_histories_vjp(
    terms: Any, terms_bar: Any, q: Array, q_bar: Array, i: int, F: Any, F_next: Any, dt: float, F_bar: Any,
    F_next_bar: Any,
) -> Any:  # fmt: skip
    """Return F_bar and F_next_bar with what the histories add to them.

    Turn the cotangents of the histories after the substep, which lie in q_bar, into those before it, and add to those
    of the parameters. `F_bar` is an empty tuple for zero.
    """
    for term, term_bar in zip(terms, terms_bar, strict=True):
        if has_history(type(term)):
            theta, h = load_rows(term.theta, term.rows, i), load_history(term, q, i)
            bars = update_vjp(term, theta, F, F_next, h, dt, load_history(term, q_bar, i))
            accumulate_rows(term_bar.theta, term.rows, i, bars[0])
            store_history(term, q_bar, i, bars[3])
            F_bar, F_next_bar = sum_of(F_bar, bars[1]), add(F_next_bar, bars[2])
    return F_bar, F_next_bar


@overload(update_histories_vjp)
def _update_histories_vjp(terms, terms_bar, q, q_bar, i, F, F_next, dt, F_bar, F_next_bar):
    if len(terms) == 0:
        return lambda terms, terms_bar, q, q_bar, i, F, F_next, dt, F_bar, F_next_bar: (F_bar, F_next_bar)

    def none(terms, terms_bar, q, q_bar, i, F, F_next, dt, F_bar, F_next_bar):
        return update_histories_vjp(terms[1:], terms_bar[1:], q, q_bar, i, F, F_next, dt, F_bar, F_next_bar)

    def several(terms, terms_bar, q, q_bar, i, F, F_next, dt, F_bar, F_next_bar):
        theta, h = load_rows(terms[0].theta, terms[0].rows, i), load_history(terms[0], q, i)
        bars = update_vjp(terms[0], theta, F, F_next, h, dt, load_history(terms[0], q_bar, i))
        accumulate_rows(terms_bar[0].theta, terms[0].rows, i, bars[0])
        store_history(terms[0], q_bar, i, bars[3])
        more, next_more = sum_of(F_bar, bars[1]), add(F_next_bar, bars[2])
        return update_histories_vjp(terms[1:], terms_bar[1:], q, q_bar, i, F, F_next, dt, more, next_more)

    return several if has_history(terms[0].instance_class) else none


def sum_of(a: Any, b: Any) -> Any:
    """Return a + b for tensors; an empty tuple stands for zero."""
    return add(a, b) if len(a) and len(b) else a or b


@overload(sum_of)
def _sum_of(a, b):
    if len(a) == 0:
        return lambda a, b: b
    return (lambda a, b: a) if len(b) == 0 else (lambda a, b: add(a, b))
