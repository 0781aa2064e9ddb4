"""What a force that stays the same through a control step is: it depends on the activation alone, not on the state.

A kind of steady force reaches the kernels as a `NamedTuple` of its own class that holds all actuators of the kind, with
the field `columns`, their particles. The class picks two functions, called once a control step by one thread:

    hold(kernel, levels, control, fields, force)                                     adds to force
    hold_vjp(kernel, levels, levels_bar, control, fields, fields_bar, force_bar)      adds to the other cotangents

fields, force (D, n) [N] and its cotangent, summed over the substeps of the control step, are packed (`packed.py`).
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
    """Make `hold` and `hold_vjp` the functions of a kernel class, and `make` what builds it.

    `make(actuators, columns, constants)` takes the numbers of the kind's actuators among all, and for each its
    particles and its `Actuator.constants`.
    """
    _HOLD.register(kernel_class, hold)
    _HOLD_VJP.register(kernel_class, hold_vjp)
    _MAKE[kernel_class] = make


def make_steady(kernel_class: type, actuators: Array, columns: list[Array], constants: list[Array]) -> Any:
    """Return the kernels' view of all actuators of one kind."""
    return _MAKE[kernel_class](actuators, columns, constants)


def is_steady(kernel_class: type) -> bool:
    """Say whether a kernel class is of a steady force."""
    return kernel_class in _MAKE


def starts_of(pieces: Sequence[Array]) -> tuple[Array, Array]:
    """Return where each piece begins in their concatenation (A + 1,), and the concatenation."""
    start = np.cumsum([0, *(len(piece) for piece in pieces)]).astype(np.int64)
    return start, np.concatenate([np.zeros(0, np.int64), *pieces]).astype(np.int64)
