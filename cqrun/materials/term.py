"""The interface of a constitutive term to the kernels: Kirchhoff stress, an optional history, and their adjoints.

The stress of a material is a sum of terms. Kernels get a term as a `NamedTuple` of its own class, with per-particle
parameters `theta` (rows, n) and `rows`, a tuple whose length is the number of rows and so known at compile time. The
class selects the functions:

    stress(term, theta, F, C)               -> tau
    stress_vjp(term, theta, F, C, tau_bar)  -> theta_bar, F_bar, C_bar

theta is a tuple of the rows at one lane of particles, F and C are tuples of D * D numbers (`tensor.py`), and tau is the
Kirchhoff stress P F^T [Pa]. An adjoint is linear in its cotangent; it returns its results and does not add them.

A term with history declares numbers of the state in `MaterialTerm.history`. Its kernel class has one more field,
`history`, a tuple of the rows of these numbers in the state; its functions get their values h as a tuple, at the
substep's beginning, and give those at its end:

    stress_and_history(term, theta, F, C, h, dt)                           -> tau, h_next
    stress_and_history_vjp(term, theta, F, C, h, dt, tau_bar, h_next_bar)  -> theta_bar, F_bar, C_bar, h_bar

All depend on F and C at the substep's beginning, so a particle is looked at once in a substep.

A term may have a second kernel class for motions, and says so with `register_in_motion`. A term with history whose
bodies come to rest has one: the first class is what the term is at rest, without history, and `register_settled` says
which history bodies have that have rested at F for long:

    settled(term, theta, F, dt)             -> h
    settled_vjp(term, theta, F, dt, h_bar)  -> theta_bar, F_bar

A term whose energy has a part U(J) of the volume ratio J = det F alone says so with `register_volume`, so that volumes
can be averaged (engine/reference/volume.py). Its stress holds J U'(J) I. U' is its slope:

    volume_slope(term, theta, J)                  -> U'
    volume_slope_vjp(term, theta, J, slope_bar)   -> theta_bar, J_bar

A term that stores energy, psi per volume at rest with P = d psi / dF, says so with `register_energy`, so that a scene
can measure it (measures/material.py):

    energy(term, theta, F)               -> psi
    energy_vjp(term, theta, F, psi_bar)  -> theta_bar, F_bar
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
from numba.core import types
from numba.extending import overload, register_jitable

from cqrun.numerics.compile import written
from cqrun.numerics.dispatch import ByClass
from cqrun.numerics.packed import accumulate, load
from cqrun.plugin.contract import Array, Plugin
from cqrun.state import StateField

_STRESS = ByClass("kirchhoff", "term, theta, F, C")
_STRESS_VJP = ByClass("kirchhoff_vjp", "term, theta, F, C, tau_bar")
_BOTH = ByClass("kirchhoff_both", "term, theta, F, C, tau_bar")
_HISTORY = ByClass("stress_and_history", "term, theta, F, C, h, dt")
_HISTORY_VJP = ByClass("stress_and_history_vjp", "term, theta, F, C, h, dt, tau_bar, h_next_bar")
_HISTORY_BOTH = ByClass("stress_and_history_both", "term, theta, F, C, h, dt, tau_bar, h_next_bar")
_SETTLED = ByClass("settled", "term, theta, F, dt")
_SETTLED_VJP = ByClass("settled_vjp", "term, theta, F, dt, h_bar")
_VOLUME = ByClass("volume_slope", "term, theta, J")
_VOLUME_VJP = ByClass("volume_slope_vjp", "term, theta, J, slope_bar")
_ENERGY = ByClass("energy", "term, theta, F")
_ENERGY_VJP = ByClass("energy_vjp", "term, theta, F, psi_bar")
_RATES: set[type] = set()
_LIMITS: dict[type, str] = {}
_IN_MOTION: dict[type, tuple[type, Callable[..., Any]]] = {}
_HOLDS_LAW: set[type] = set()
kirchhoff, kirchhoff_vjp, kirchhoff_both = (f.call for f in (_STRESS, _STRESS_VJP, _BOTH))
stress_and_history, stress_and_history_vjp, stress_and_history_both = (
    f.call for f in (_HISTORY, _HISTORY_VJP, _HISTORY_BOTH)
)
settled, settled_vjp = _SETTLED.call, _SETTLED_VJP.call
volume_slope, volume_slope_vjp = _VOLUME.call, _VOLUME_VJP.call
energy, energy_vjp = _ENERGY.call, _ENERGY_VJP.call


class MaterialTerm(Plugin):
    """A term of a material's stress in a scene.

    `parameters` names the fields that become rows of theta, in this order. A value is one number or one per particle
    (N,).
    """

    relaxes: ClassVar[bool] = False
    """Whether a term with a history has no stress where bodies have rested for long, so that equilibria exist."""

    @property
    def at_once(self) -> float:
        """By how much a sudden change of shape meets more than the shear modulus of the law."""
        return 1.0

    def bind(self, law: Any) -> None:
        """Take note of the elastic law of the material; called once, before anything else."""

    def kernel_term(self, theta: Array) -> Any:
        """Return the kernel's view of this term for parameters theta (rows, n)."""
        raise NotImplementedError

    def history(self, dim: int) -> tuple[StateField, ...]:
        """Return the fields that this term adds to the state in `dim` dimensions; most terms add none.

        The state prefixes their names with the plug-in's: `Q_1` of the term `prony` becomes `prony.Q_1`.
        """
        return ()

    @staticmethod
    def wave_modulus(theta: Array) -> Array:
        """Return the term's part of rho c^2, the stiffness of a pressure wave at rest [Pa], shape (n,)."""
        return np.zeros(theta.shape[1])

    @staticmethod
    def shear_modulus(theta: Array) -> Array:
        """Return the term's part of the shear modulus mu at rest [Pa], shape (n,); theta may be complex."""
        return theta[0] * 0.0

    @staticmethod
    def wave_viscosity(theta: Array) -> Array:
        """Return the term's part of 4/3 eta + zeta [Pa s], shape (n,)."""
        return np.zeros(theta.shape[1])


def register(
    kernel_class: type, stress: Callable[..., Any], stress_vjp: Callable[..., Any], *, rate: bool = True,
    both: Callable[..., Any] | None = None,
) -> None:  # fmt: skip
    """Register the functions of a kernel class without history.

    Args:
        rate: whether the stress depends on C.
        both: returns (tau, *stress_vjp(...)), where that saves work; made from the other two if not given.
    """
    _STRESS.register(kernel_class, stress)
    _STRESS_VJP.register(kernel_class, stress_vjp)
    _BOTH.register(kernel_class, both or one_after_the_other(stress, stress_vjp))
    _RATES.update([kernel_class] if rate else [])


def register_with_history(
    kernel_class: type, stress: Callable[..., Any], stress_vjp: Callable[..., Any], *, rate: bool = True,
    both: Callable[..., Any] | None = None,
) -> None:  # fmt: skip
    """Register `stress_and_history` and its adjoint for a kernel class with history; options as in `register`."""
    _HISTORY.register(kernel_class, stress)
    _HISTORY_VJP.register(kernel_class, stress_vjp)
    _HISTORY_BOTH.register(kernel_class, both or one_after_the_other_with_history(stress, stress_vjp))
    _RATES.update([kernel_class] if rate else [])


def register_settled(kernel_class: type, settled: Callable[..., Any], settled_vjp: Callable[..., Any]) -> None:
    """Register the history that bodies have after a long rest, and its adjoint."""
    _SETTLED.register(kernel_class, settled)
    _SETTLED_VJP.register(kernel_class, settled_vjp)


def register_in_motion(
    kernel_class: type, moving_class: type, make: Callable[..., Any], *, holds_law: bool = False
) -> None:
    """Register the class that stands for a kernel class in motions.

    Args:
        make: make(view, dt) returns the view for substeps dt [s]; its theta may have more rows, after the others.
        holds_law: whether its stress holds that of the elastic law, so that the law is evaluated once in a substep.
    """
    _IN_MOTION[kernel_class] = moving_class, make
    _HOLDS_LAW.update([moving_class] if holds_law else [])


def in_motion(view: Any, dt: float) -> Any:
    """Return a term's view for motions with substeps dt [s]."""
    return _IN_MOTION[type(view)][1](view, dt) if type(view) in _IN_MOTION else view


def holds_law(kernel_class: type) -> bool:
    """Return whether the stress of a kernel class holds that of the elastic law, the first term of a material."""
    return kernel_class in _HOLDS_LAW


def register_volume(kernel_class: type, slope: Callable[..., Any], slope_vjp: Callable[..., Any]) -> None:
    """Register the slope of a kernel class's energy of volume, and its adjoint."""
    _VOLUME.register(kernel_class, slope)
    _VOLUME_VJP.register(kernel_class, slope_vjp)


def register_energy(kernel_class: type, energy: Callable[..., Any], energy_vjp: Callable[..., Any]) -> None:
    """Register the energy of a kernel class, and its adjoint."""
    _ENERGY.register(kernel_class, energy)
    _ENERGY_VJP.register(kernel_class, energy_vjp)


def register_limit(kernel_class: type, sentence: str) -> None:
    """Register a sentence on the deformation beyond which a kernel class has no stress (NaN)."""
    _LIMITS[kernel_class] = sentence


def limit_of(kernel_class: type) -> str:
    """Return the sentence on the deformation beyond which a kernel class has no stress; empty if it has none."""
    return _LIMITS.get(kernel_class, "")


def one_after_the_other(stress: Callable[..., Any], stress_vjp: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function that gives the stress and the cotangents, from one for each."""
    first, second = (f if hasattr(f, "py_func") else register_jitable(f) for f in (stress, stress_vjp))

    def both(term: Any, theta: Any, F: Any, C: Any, tau_bar: Any) -> Any:
        bars = second(term, theta, F, C, tau_bar)
        return first(term, theta, F, C), bars[0], bars[1], bars[2]

    return both


def one_after_the_other_with_history(stress: Callable[..., Any], stress_vjp: Callable[..., Any]) -> Callable[..., Any]:
    """Return what `one_after_the_other` returns, for a term with history; the stress is without h_next."""
    first, second = (f if hasattr(f, "py_func") else register_jitable(f) for f in (stress, stress_vjp))

    def both(term: Any, theta: Any, F: Any, C: Any, h: Any, dt: Any, tau_bar: Any, h_next_bar: Any) -> Any:
        bars = second(term, theta, F, C, h, dt, tau_bar, h_next_bar)
        return first(term, theta, F, C, h, dt)[0], bars[0], bars[1], bars[2], bars[3]

    return both


def needs_rate(kernel_class: type) -> bool:
    """Return whether the stress of a kernel class depends on the velocity gradient C."""
    return kernel_class in _RATES


def has_volume(kernel_class: type) -> bool:
    """Return whether the energy of a kernel class has a part of the volume ratio alone."""
    return kernel_class in _VOLUME


def has_energy(kernel_class: type) -> bool:
    """Return whether the energy of a kernel class is known."""
    return kernel_class in _ENERGY


def is_stress(kernel_class: type) -> bool:
    """Return whether a kernel class belongs to a term of the stress."""
    return kernel_class in _STRESS or kernel_class in _HISTORY


def has_history(kernel_class: type) -> bool:
    """Return whether the terms of a kernel class have a history."""
    return kernel_class in _HISTORY


# --- lane values of parameters ----------------------------------------------------------------------------


def load_rows(theta: Array, rows: tuple[int, ...], i: int) -> Any:
    """Return the lane values theta[0, i], theta[1, i], ... as a tuple as long as `rows`."""
    return tuple(load(theta, r, i) for r in range(len(rows)))


def written_tuple(item: str, n: int) -> str:
    """Return the source of a tuple of n entries: `item` with r = 0, 1, ..."""
    return "(" + "".join(item.format(r=r) + ", " for r in range(n)) + ")"


@overload(load_rows)
def _load_rows(theta, rows, i):
    entries = written_tuple("load(theta, {r}, i)", len(rows))
    return written(f"lambda theta, rows, i: {entries}", {"load": load})


def accumulate_rows(theta_bar: Array, rows: tuple[int, ...], i: int, values: Any) -> None:
    """Add a tuple of lane values to the rows of theta_bar at i."""
    for r in range(len(rows)):
        accumulate(theta_bar, r, i, values[r])


@overload(accumulate_rows)
def _accumulate_rows(theta_bar, rows, i, values):
    entries = written_tuple("accumulate(theta_bar, {r}, i, values[{r}])", len(rows))
    return written(f"lambda theta_bar, rows, i, values: {entries}", {"accumulate": accumulate})


def zeros_like_rows(a: Any) -> Any:
    """Return a tensor of zeros like the tensor `a`, of lanes or numbers."""
    return tuple(entry * 0.0 for entry in a)


@overload(zeros_like_rows)
def _zeros_like_rows(a):
    if not isinstance(a, types.BaseTuple):
        return None
    return written("lambda a: " + written_tuple("a[{r}] * 0.0", len(a)))


def add_rows(a: Any, b: Any) -> Any:
    """Return the sums of the entries of two tuples of one length."""
    return tuple(x + y for x, y in zip(a, b, strict=True))


@overload(add_rows)
def _add_rows(a, b):
    return written("lambda a, b: " + written_tuple("a[{r}] + b[{r}]", len(a)))


def with_row(rows: Any, row: Any) -> Any:
    """Return a tuple with one more entry at its end."""
    return (*rows, row)


@overload(with_row)
def _with_row(rows, row):
    return written("lambda rows, row: " + written_tuple("rows[{r}]", len(rows))[:-1] + "row,)")
