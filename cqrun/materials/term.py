"""What a kernel asks of a constitutive term: its Kirchhoff stress and the adjoint of it.

The stress of a material is a sum of terms. A term reaches a kernel as a `NamedTuple` of its own class, with
per-particle parameters `theta` (rows, n) and `rows`, a tuple whose length is the number of rows (so that it
is known when the kernel is compiled). The class picks the functions:

    kirchhoff(term, theta, F, C)               -> tau
    kirchhoff_vjp(term, theta, F, C, tau_bar)  -> theta_bar, F_bar, C_bar

theta is a tuple of the rows at one lane of particles, F and C are tuples of D * D (`tensor.py`), and tau is
the Kirchhoff stress P F^T [Pa]. The adjoint is linear in tau_bar, and returns rather than accumulates.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba.core import types
from numba.extending import overload, register_jitable

from cqrun.numerics.compile import own_symbols, written
from cqrun.numerics.packed import accumulate, load
from cqrun.numerics.tensor import add
from cqrun.plugin.contract import Array, Plugin

_STRESS: dict[type, Callable[..., Any]] = {}
_STRESS_VJP: dict[type, Callable[..., Any]] = {}


class MaterialTerm(Plugin):
    """A term of a material's stress, as a scene gives it.

    `parameters` names the fields that become rows of theta, in that order. Values arrive as one number or as
    one a particle (N,).
    """

    def kernel_term(self, theta: Array) -> Any:
        """Return the kernel's view of this term for parameters theta (rows, n)."""
        raise NotImplementedError

    @staticmethod
    def wave_modulus(theta: Array) -> Array:
        """Return what the term adds to rho c^2, the stiffness of a pressure wave at rest [Pa], shape (n,)."""
        return np.zeros(theta.shape[1])

    @staticmethod
    def wave_viscosity(theta: Array) -> Array:
        """Return what the term adds to 4/3 eta + zeta [Pa s], shape (n,)."""
        return np.zeros(theta.shape[1])


def register(kernel_class: type, stress: Callable[..., Any], stress_vjp: Callable[..., Any]) -> None:
    """Make `stress` and `stress_vjp` the functions of a kernel class."""
    own_symbols(kernel_class)
    _STRESS[kernel_class], _STRESS_VJP[kernel_class] = stress, stress_vjp


def kirchhoff(term: Any, theta: Any, F: Any, C: Any) -> Any:
    """Return the Kirchhoff stress of one term."""
    return _STRESS[type(term)](term, theta, F, C)


def kirchhoff_vjp(term: Any, theta: Any, F: Any, C: Any, tau_bar: Any) -> Any:
    """Return (theta_bar, F_bar, C_bar) of one term."""
    return _STRESS_VJP[type(term)](term, theta, F, C, tau_bar)


@overload(kirchhoff)
def _kirchhoff(term, theta, F, C):
    body = register_jitable(_STRESS[term.instance_class])
    return lambda term, theta, F, C: body(term, theta, F, C)


@overload(kirchhoff_vjp)
def _kirchhoff_vjp(term, theta, F, C, tau_bar):
    body = register_jitable(_STRESS_VJP[term.instance_class])
    return lambda term, theta, F, C, tau_bar: body(term, theta, F, C, tau_bar)


# --- all terms of a material -----------------------------------------------------------------------------


def load_rows(theta: Array, rows: tuple[int, ...], i: int) -> Any:
    """Return the lane values theta[0, i], theta[1, i], ... as a tuple as long as `rows`."""
    return tuple(load(theta, r, i) for r in range(len(rows)))


def _written_out(item: str, n: int) -> str:
    return "(" + "".join(item.format(r=r) + ", " for r in range(n)) + ")"


@overload(load_rows)
def _load_rows(theta, rows, i):
    entries = _written_out("load(theta, {r}, i)", len(rows))
    return written(f"lambda theta, rows, i: {entries}", {"load": load})


def accumulate_rows(theta_bar: Array, rows: tuple[int, ...], i: int, values: Any) -> None:
    """Add a tuple of lane values to the rows of theta_bar at i."""
    for r in range(len(rows)):
        accumulate(theta_bar, r, i, values[r])


@overload(accumulate_rows)
def _accumulate_rows(theta_bar, rows, i, values):
    entries = _written_out("accumulate(theta_bar, {r}, i, values[{r}])", len(rows))
    return written(f"lambda theta_bar, rows, i, values: {entries}", {"accumulate": accumulate})


def total_kirchhoff(terms: Any, i: int, F: Any, C: Any) -> Any:
    """Return the summed Kirchhoff stress of all terms for the lane of particles at i."""
    tau = kirchhoff(terms[0], load_rows(terms[0].theta, terms[0].rows, i), F, C)
    return add(tau, total_kirchhoff(terms[1:], i, F, C)) if len(terms) > 1 else tau


@overload(total_kirchhoff)
def _total_kirchhoff(terms, i, F, C):
    def one(terms, i, F, C):
        return kirchhoff(terms[0], load_rows(terms[0].theta, terms[0].rows, i), F, C)

    def several(terms, i, F, C):
        return add(one_of(terms, i, F, C), total_kirchhoff(terms[1:], i, F, C))

    one_of = register_jitable(one)
    return several if len(terms) > 1 else one


def total_kirchhoff_vjp(terms: Any, terms_bar: Any, i: int, F: Any, C: Any, tau_bar: Any) -> Any:
    """Return (F_bar, C_bar), and add to the parameters' cotangents in terms_bar."""
    theta = load_rows(terms[0].theta, terms[0].rows, i)
    theta_bar, F_bar, C_bar = kirchhoff_vjp(terms[0], theta, F, C, tau_bar)
    accumulate_rows(terms_bar[0].theta, terms[0].rows, i, theta_bar)
    if len(terms) == 1:
        return F_bar, C_bar
    F_more, C_more = total_kirchhoff_vjp(terms[1:], terms_bar[1:], i, F, C, tau_bar)
    return add(F_bar, F_more), add(C_bar, C_more)


@overload(total_kirchhoff_vjp)
def _total_kirchhoff_vjp(terms, terms_bar, i, F, C, tau_bar):
    def one(terms, terms_bar, i, F, C, tau_bar):
        theta = load_rows(terms[0].theta, terms[0].rows, i)
        theta_bar, F_bar, C_bar = kirchhoff_vjp(terms[0], theta, F, C, tau_bar)
        accumulate_rows(terms_bar[0].theta, terms[0].rows, i, theta_bar)
        return F_bar, C_bar

    def several(terms, terms_bar, i, F, C, tau_bar):
        F_bar, C_bar = one_of(terms, terms_bar, i, F, C, tau_bar)
        F_more, C_more = total_kirchhoff_vjp(terms[1:], terms_bar[1:], i, F, C, tau_bar)
        return add(F_bar, F_more), add(C_bar, C_more)

    one_of = register_jitable(one)
    return several if len(terms) > 1 else one


def zeros_like_rows(a: Any) -> Any:
    """Return a tensor of zeros like the tensor `a` of lanes or numbers."""
    return tuple(entry * 0.0 for entry in a)


@overload(zeros_like_rows)
def _zeros_like_rows(a):
    if not isinstance(a, types.BaseTuple):
        return None
    return written("lambda a: " + _written_out("a[{r}] * 0.0", len(a)))
