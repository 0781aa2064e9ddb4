"""Load and store lanes of small tensors in the rows of an array, and in records of four.

The length of a function's last argument is the dimension (`dims` is a tuple of this length); it selects the body.
Without the JIT the same source runs on NumPy slices.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba.extending import overload

from cqrun.numerics.compile import written
from cqrun.numerics.lanes import floor, lane, select
from cqrun.numerics.packed import accumulate, load, store
from cqrun.numerics.records import load_quads, make4, store_quads
from cqrun.state import MOTION, state_table

_NAMES = {
    "load": load, "store": store, "accumulate": accumulate, "load_quads": load_quads, "store_quads": store_quads,
    "lane": lane, "make4": make4, "floor": floor, "select": select,
}  # fmt: skip


def _per_dimension(signature: str, body: Callable[[int], str]) -> Any:
    """Return a function of the named arguments from its source for each dimension."""
    last = signature.rpartition(" ")[2]
    bodies = {dim: written(f"lambda {signature}: {body(dim)}", dict(_NAMES)) for dim in (2, 3)}
    scope: dict[str, Any] = {"bodies": bodies}
    exec(f"def function({signature}):\n    return bodies[len({last})]({signature})", scope)
    exec(f"def choose({signature}):\n    return bodies[len({last})]", scope)
    overload(scope["function"])(scope["choose"])
    return scope["function"]


def _tuple(entries: list[str]) -> str:
    return "(" + "".join(entry + ", " for entry in entries) + ")"


def _of_field(name: str, item: str, more: str = "") -> Any:
    """Return a function of (q, i, ..., dims) on the rows of a field of the state."""

    def body(dim: int) -> str:
        rows = state_table(dim).rows[name]
        return _tuple([item.format(r=r, k=k) for k, r in enumerate(range(rows.start, rows.stop))])

    return _per_dimension(f"q, i, {more}dims", body)


load_x, load_v, load_C, load_F = (_of_field(name, "load(q, {r}, i)") for name in MOTION)
store_x, store_v, store_C, store_F = (_of_field(name, "store(q, {r}, i, u[{k}])", "u, ") for name in MOTION)
add_x = _of_field("x", "accumulate(q, {r}, i, u[{k}])", "u, ")
first_row_of_v = _per_dimension("dims", lambda d: str(state_table(d).rows["v"].start))

# vectors in other tables; r is their first row
load_vector = _per_dimension("a, r, i, dims", lambda d: _tuple([f"load(a, r + {k}, i)" for k in range(d)]))
store_vector = _per_dimension("a, r, i, u, dims", lambda d: _tuple([f"store(a, r + {k}, i, u[{k}])" for k in range(d)]))
add_vector = _per_dimension(
    "a, r, i, u, dims", lambda d: _tuple([f"accumulate(a, r + {k}, i, u[{k}])" for k in range(d)])
)

# matrices in tables of their own
load_matrix = _per_dimension("a, i, dims", lambda d: _tuple([f"load(a, {k}, i)" for k in range(d * d)]))
store_matrix = _per_dimension("a, i, A, dims", lambda d: _tuple([f"store(a, {k}, i, A[{k}])" for k in range(d * d)]))

# records of four: a vector has entries 0 .. D - 1 and the extra number entry 3, a place has entries 3 - D .. 2
components = _per_dimension("a, dims", lambda d: _tuple([f"lane(a, {k})" for k in range(d)]))
record_of = _per_dimension("extra, like, u", lambda d: f"make4(u[0], u[1], {'u[2]' if d == 3 else '0.0'}, extra, like)")
put_vector = _per_dimension(
    "a, i, u, extra, dims", lambda d: f"store_quads(a, i, u[0], u[1], {'u[2]' if d == 3 else '0.0'}, extra)"
)
put_place = _per_dimension(
    "a, i, X, dims", lambda d: f"store_quads(a, i, {'X[0], X[1], X[2]' if d == 3 else '1.0, X[0], X[1]'}, 0.0)"
)
get_vector = _per_dimension("a, i, dims", lambda d: f"load_quads(a, i)[:{d}]")
get_extra = _per_dimension("a, i, dims", lambda d: "load_quads(a, i)[3]")
get_place = _per_dimension("a, i, dims", lambda d: f"load_quads(a, i)[{3 - d}:3]")


def _put_column(d: int, axis: int) -> str:
    entries = [f"A[{row * d + axis}]" if row < d else "0.0" for row in range(3)]
    return f"store_quads(a, {axis + 3 - d} * n + i, {', '.join(entries)}, 0.0)"


put_columns = _per_dimension("a, n, i, A, dims", lambda d: _tuple([_put_column(d, axis) for axis in range(d)]))
get_columns = _per_dimension(
    "a, n, i, dims",
    lambda d: _tuple([f"load_quads(a, {axis + 3 - d} * n + i)[{row}]" for row in range(d) for axis in range(d)]),
)

fraction = _per_dimension("X", lambda d: _tuple([f"X[{k}] - floor(X[{k}] - 0.5)" for k in range(d)]))
within = _per_dimension("X, upper", lambda d: " & ".join(f"(X[{k}] > 1.0) & (X[{k}] < upper[{k}])" for k in range(d)))
_square = {d: " + ".join(f"v[{k}] * v[{k}]" for k in range(d)) for d in (2, 3)}
greatest_square = _per_dimension("a, v", lambda d: f"select(a > {_square[d]}, a, {_square[d]})")
"""Return the larger of a and |v|^2."""
