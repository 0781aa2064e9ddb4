"""Tuples of a stress that relaxes (`prony.py`): the rows of theta and of the history, branch by branch.

theta has a ratio and a time for each branch, then the rows of the elastic law, and last a = exp(-dt/(2 time)) of each
branch. The history has the rows of each branch's Q. Entries of tuples are written out, because Numba does not unpack
tuples.
"""

from __future__ import annotations

from typing import Any

from numba.extending import overload, register_jitable

from cqrun.materials.term import written_tuple
from cqrun.numerics.compile import written


def law_rows(theta: Any, branches: Any) -> Any:
    """Return the rows of the elastic law."""
    return theta[2 * len(branches) : len(theta) - len(branches)]


@overload(law_rows)
def _law_rows(theta, branches):
    begin, count = 2 * len(branches), len(theta) - 3 * len(branches)
    entries = "".join(f"theta[{begin + r}], " for r in range(count))
    return written(f"lambda theta, branches: ({entries})")


def in_branches(function: Any, name: str, arguments: str) -> Any:
    """Return the function that joins function(ratio, time, a, k, ...) of all branches to one tuple.

    k is the branch's number, and a is exp(-dt/(2 time)).
    """

    def every(theta: Any, branches: Any, *given: Any) -> Any:
        n = len(branches)
        parts = [function(theta[2 * k], theta[2 * k + 1], theta[k - n], k, *given) for k in range(n)]
        return tuple(entry for part in parts for entry in part)

    def compiled(theta: Any, branches: Any) -> Any:
        first = len(theta) - len(branches)
        parts = [
            f"one(theta[{2 * k}], theta[{2 * k + 1}], theta[{first + k}], {k}, {arguments})"
            for k in range(len(branches))
        ]
        return written(f"lambda theta, branches, {arguments}: {' + '.join(parts)}", {"one": one})

    one = register_jitable(function)
    scope: dict[str, Any] = {"every": every, "compiled": compiled}
    exec(f"def {name}(theta, branches, {arguments}):\n    return every(theta, branches, {arguments})", scope)
    exec(f"def choose(theta, branches, {arguments}):\n    return compiled(theta, branches)", scope)
    overload(scope[name])(scope["choose"])
    return scope[name]


def branch(h: Any, k: int, rows: Any) -> Any:
    """Return the rows of branch k of a history, as many as `rows` has."""
    n = len(rows)
    return tuple(h[k * n + r] for r in range(n))


@overload(branch)
def _branch(h, k, rows):
    return written("lambda h, k, rows: " + written_tuple(f"h[k * {len(rows)} + {{r}}]", len(rows)))


def summed(rows: Any, like: Any) -> Any:
    """Return the sum over the branches of their rows, which are as many as `like` has."""
    n = len(like)
    return tuple(sum(rows[k] for k in range(r, len(rows), n)) for r in range(n))


@overload(summed)
def _summed(rows, like):
    n = len(like)
    entries = ", ".join(" + ".join(f"rows[{k}]" for k in range(r, len(rows), n)) for r in range(n))
    return written(f"lambda rows, like: ({entries},)")


def total(h: Any, weights: Any, S: Any) -> Any:
    """Return the rows of (1 + sum of the weights) S + the sum of those of all Q."""
    n, whole = len(S), 1.0 + sum(weights)
    return tuple(S[r] * whole + sum(h[k] for k in range(r, len(h), n)) for r in range(n))


@overload(total)
def _total(h, weights, S):
    n, whole = len(S), " + ".join(f"weights[{k}]" for k in range(len(weights)))
    entries = ", ".join(f"S[{r}] * whole + " + " + ".join(f"h[{k}]" for k in range(r, len(h), n)) for r in range(n))
    inner = register_jitable(written(f"lambda h, whole, S: ({entries},)"))
    return written(f"lambda h, weights, S: inner(h, {whole} + 1.0, S)", {"inner": inner})


def all_rows(theta: Any, branches_bar: Any, law_bar: Any) -> Any:
    """Return the cotangent of all rows from those of the branches and of the law; the last rows have none."""
    return branches_bar + law_bar + tuple(row * 0.0 for row in theta[len(branches_bar) + len(law_bar) :])


@overload(all_rows)
def _all_rows(theta, branches_bar, law_bar):
    zeros = "".join(f"theta[{r}] * 0.0, " for r in range(len(branches_bar) + len(law_bar), len(theta)))
    return written(f"lambda theta, branches_bar, law_bar: branches_bar + law_bar + ({zeros})")


def scale_rows(a: Any, s: Any) -> Any:
    """Return the entries of a tuple times a number."""
    return tuple(entry * s for entry in a)


@overload(scale_rows)
def _scale_rows(a, s):
    return written("lambda a, s: " + written_tuple("a[{r}] * s", len(a)))


def dot_rows(a: Any, b: Any) -> Any:
    """Return the sum of the products of the entries of two tuples."""
    return sum(x * y for x, y in zip(a, b, strict=True))


@overload(dot_rows)
def _dot_rows(a, b):
    return written("lambda a, b: " + " + ".join(f"a[{r}] * b[{r}]" for r in range(len(a))))
