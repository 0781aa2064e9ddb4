"""Small tensors as tuples: a vector has D entries, a matrix D * D in row-major order.

The length of the tuple selects the 2D or the 3D body when a kernel is compiled. Entries are numbers, lanes
(`lanes.py`), or without the JIT NumPy arrays, also complex ones. Most functions are defined by an index formula for
both dimensions; the others have a body for each dimension.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

from numba.extending import overload, register_jitable

from cqrun.numerics.compile import named, written


def _dimension(rank: int, length: int) -> int:
    dim = {(1, 2): 2, (1, 3): 3, (2, 4): 2, (2, 9): 3}.get((rank, length))
    if dim is None:
        raise TypeError(f"a tuple of {length} is not a tensor of rank {rank} in 2D or 3D")
    return dim


def _source(subscripts: str, dim: int) -> str:
    """Return the source of a lambda on tuples a, b for an index formula like `ik,kj->ij` and one dimension."""
    inputs, output = subscripts.split("->")
    operands = inputs.split(",")
    summed = sorted(set("".join(operands)) - set(output))

    def entry(bound: dict[str, int]) -> str:
        terms = []
        for values in itertools.product(range(dim), repeat=len(summed)):
            at = bound | dict(zip(summed, values, strict=True))
            factors = []
            for name, indices in zip("abc", operands, strict=False):
                flat = 0
                for letter in indices:
                    flat = flat * dim + at[letter]
                factors.append(f"{name}[{flat}]")
            terms.append(" * ".join(factors))
        return " + ".join(terms)

    entries = [
        entry(dict(zip(output, values, strict=True))) for values in itertools.product(range(dim), repeat=len(output))
    ]
    names = ", ".join("abc"[: len(operands)])
    body = "(" + ", ".join(entries) + ",)" if output else entries[0]
    return f"lambda {names}: {body}"


def contraction(subscripts: str) -> Callable[..., Any]:
    """Return the function of one or two small tensors that has this index formula, in 2D and 3D."""
    operands = subscripts.split("->")[0].split(",")
    rank = len(operands[0])
    bodies = {dim: written(_source(subscripts, dim)) for dim in (2, 3)}

    names = ", ".join("ab"[: len(operands)])
    scope: dict[str, Any] = {"body": lambda a: bodies[_dimension(rank, len(a))]}
    exec(f"def function({names}):\n    return body(a)({names})", scope)
    exec(f"def choose({names}):\n    return body(a)", scope)
    overload(scope["function"])(scope["choose"])
    return scope["function"]


def elementwise(signature: str, body: str) -> Callable[..., Any]:
    """Return an entry-by-entry function, such as `a[i] + b[i]`, of tuples of any length."""
    bodies = {}
    for length in (2, 3, 4, 6, 9):
        entries = "".join(body.replace("[i]", f"[{i}]") + ", " for i in range(length))
        bodies[length] = written(f"lambda {signature}: ({entries})")
    scope: dict[str, Any] = {"bodies": bodies}
    exec(f"def function({signature}):\n    return bodies[len(a)]({signature})", scope)
    exec(f"def choose({signature}):\n    return bodies[len(a)]", scope)
    overload(scope["function"])(scope["choose"])
    return scope["function"]


dot = contraction("i,i->")
outer = contraction("i,j->ij")
inner = contraction("ij,ij->")  # A : B
trace = contraction("ii->")
transpose = contraction("ji->ij")
mul = contraction("ik,kj->ij")  # A B
mul_bt = contraction("ik,jk->ij")  # A B^T
mul_at = contraction("ki,kj->ij")  # A^T B
matvec = contraction("ij,j->i")  # A u
matvec_t = contraction("ji,j->i")  # A^T u
add = elementwise("a, b", "a[i] + b[i]")
sub = elementwise("a, b", "a[i] - b[i]")
scale = elementwise("a, s", "a[i] * s")
shift = elementwise("a, s", "a[i] + s")


def by_dimension(in_2d: Callable[..., Any], in_3d: Callable[..., Any]) -> Callable[[Any], Any]:
    """Return the function of one matrix that selects its body by the matrix's length."""
    compiled = {4: register_jitable(in_2d), 9: register_jitable(in_3d)}

    def function(a: Any) -> Any:
        return (in_2d if len(a) == 4 else in_3d)(a)

    @overload(function)
    def _(a):
        body = compiled[len(a)]
        return named(lambda a: body(a), f"{in_3d.__name__}_{len(a)}")

    function.__doc__ = in_3d.__doc__
    return function


def _det_2d(a: Any) -> Any:
    """Return the determinant."""
    return a[0] * a[3] - a[1] * a[2]


def _det_3d(a: Any) -> Any:
    """Return the determinant."""
    return a[0] * (a[4] * a[8] - a[5] * a[7]) - a[1] * (a[3] * a[8] - a[5] * a[6]) + a[2] * (a[3] * a[7] - a[4] * a[6])


def _cofactor_2d(a: Any) -> Any:
    """Return the cofactor matrix J A^-T, the derivative of det(A)."""
    return (a[3], -a[2], -a[1], a[0])


def _cofactor_3d(a: Any) -> Any:
    """Return the cofactor matrix J A^-T, the derivative of det(A)."""
    return (
        a[4] * a[8] - a[5] * a[7],
        a[5] * a[6] - a[3] * a[8],
        a[3] * a[7] - a[4] * a[6],
        a[2] * a[7] - a[1] * a[8],
        a[0] * a[8] - a[2] * a[6],
        a[1] * a[6] - a[0] * a[7],
        a[1] * a[5] - a[2] * a[4],
        a[2] * a[3] - a[0] * a[5],
        a[0] * a[4] - a[1] * a[3],
    )


det = by_dimension(_det_2d, _det_3d)
cofactor = by_dimension(_cofactor_2d, _cofactor_3d)


def plus_diagonal(a: Any, s: Any) -> Any:
    """Return A + s I."""
    return _PLUS[len(a)](a, s)


_PLUS = {
    4: lambda a, s: (a[0] + s, a[1], a[2], a[3] + s),
    9: lambda a, s: (a[0] + s, a[1], a[2], a[3], a[4] + s, a[5], a[6], a[7], a[8] + s),
}


@overload(plus_diagonal)
def _plus_diagonal(a, s):
    return _PLUS[len(a)]


@register_jitable
def symmetric(a: Any) -> Any:
    """Return (A + A^T) / 2."""
    return scale(add(a, transpose(a)), 0.5)


@register_jitable
def vector(number: Any, i: int) -> Any:
    """Return three numbers of an array, from the i-th on."""
    return number[i], number[i + 1], number[i + 2]
