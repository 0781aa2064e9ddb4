"""Steady forces: they depend on the activation only, not on the state, and so are constant in a control step.

Kernels get a kind of steady force as a `NamedTuple` of its own class with all actuators of the kind; its field
`columns` has their particles. The class selects two functions, which one thread calls once per control step:

    hold(kernel, levels, control, fields, force)                                     adds to force
    hold_vjp(kernel, levels, levels_bar, control, fields, fields_bar, force_bar)      adds to the other cotangents

`fields`, `force` (D, n) [N] and its cotangent, summed over the substeps of the control step, are packed (`packed.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from cqrun.numerics.dispatch import ByClass
from cqrun.plugin.contract import Array

_HOLD = ByClass("hold", "kernel, levels, control, fields, force")
_HOLD_VJP = ByClass("hold_vjp", "kernel, levels, levels_bar, control, fields, fields_bar, force_bar")
hold, hold_vjp = _HOLD.call, _HOLD_VJP.call

_MAKE: dict[type, Callable[[Array, list[Array], list[Array]], Any]] = {}


def register_steady(
    kernel_class: type,
    make: Callable[[Array, list[Array], list[Array]], Any],
    hold: Callable[..., None],
    hold_vjp: Callable[..., None],
) -> None:
    """Register the functions of a kernel class.

    `make(actuators, columns, constants)` returns the kernels' view, for the numbers of the kind's actuators among all
    actuators, and for the particles and `Actuator.constants` of each.
    """
    _HOLD.register(kernel_class, hold)
    _HOLD_VJP.register(kernel_class, hold_vjp)
    _MAKE[kernel_class] = make


def make_steady(kernel_class: type, actuators: Array, columns: list[Array], constants: list[Array]) -> Any:
    """Return the kernels' view of all actuators of one kind."""
    return _MAKE[kernel_class](actuators, columns, constants)


def is_steady(kernel_class: type) -> bool:
    """Return whether a kernel class belongs to a steady force."""
    return kernel_class in _MAKE


def starts_of(pieces: Sequence[Array]) -> tuple[Array, Array]:
    """Return where each piece begins in their concatenation (A + 1,), and the concatenation."""
    start = np.cumsum([0, *(len(piece) for piece in pieces)]).astype(np.int64)
    return start, np.concatenate([np.zeros(0, np.int64), *pieces]).astype(np.int64)
