"""What a kernel asks of an actuator that exerts forces on particles.

A kind of force reaches the kernels as a `NamedTuple` of its own class that holds all actuators of the kind:
`columns` are their particles, `actuators` which of the scene's they are. The class picks two kernels:

    push(kernel, drive, control, q, fields, force)
    push_vjp(kernel, drive, drive_bar, control, q, q_bar, fields, fields_bar)

`drive.activation[control, a]` [1], `drive.strength[a]` and `drive.rest[a]` [m] belong to actuator a; q, fields and
force (D, n) [N] are packed (`state.py`, `packed.py`). The first adds to `force`; the second takes
`drive_bar.push`, the cotangent of `force`, and adds to those of all others. Both run every substep on one thread, over
few particles.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numba.extending import overload

from cqrun.numerics.compile import named, own_symbols
from cqrun.plugin.contract import Array

_PUSH: dict[type, tuple[Callable[..., None], Callable[..., None]]] = {}
_MAKE: dict[type, Callable[[Array, list[Array], list[Array]], Any]] = {}


def register_push(
    kernel_class: type,
    make: Callable[[Array, list[Array], list[Array]], Any],
    push: Callable[..., None],
    push_vjp: Callable[..., None],
) -> None:
    """Make `push` and `push_vjp` the functions of a kernel class, and `make` what builds it.

    `make(actuators, columns, constants)` takes the numbers of the kind's actuators among all, and for each its
    particles and its `Actuator.constants`.
    """
    own_symbols(kernel_class)
    _PUSH[kernel_class], _MAKE[kernel_class] = (push, push_vjp), make


def make_kernel(kernel_class: type, actuators: Array, columns: list[Array], constants: list[Array]) -> Any:
    """Return the kernels' view of all actuators of one kind."""
    return _MAKE[kernel_class](actuators, columns, constants)


def pushes(kernel_class: type) -> bool:
    """Say whether a kernel class exerts forces; the others are terms of the stress."""
    return kernel_class in _PUSH


def push(kernel: Any, drive: Any, control: int, q: Array, fields: Array, force: Array) -> None:
    """Add the forces of one kind of actuator."""
    _PUSH[type(kernel)][0](kernel, drive, control, q, fields, force)


def push_vjp(
    kernel: Any, drive: Any, drive_bar: Any, control: int, q: Array, q_bar: Array, fields: Array, fields_bar: Array
) -> None:
    """Add to the cotangents of activation, strength, q and fields."""
    _PUSH[type(kernel)][1](kernel, drive, drive_bar, control, q, q_bar, fields, fields_bar)


@overload(push)
def _push(kernel, drive, control, q, fields, force):
    kind = kernel.instance_class
    body = _PUSH[kind][0]

    def run(kernel, drive, control, q, fields, force):
        body(kernel, drive, control, q, fields, force)

    return named(run, f"push_{kind.__name__}")


@overload(push_vjp)
def _push_vjp(kernel, drive, drive_bar, control, q, q_bar, fields, fields_bar):
    kind = kernel.instance_class
    body = _PUSH[kind][1]

    def run(kernel, drive, drive_bar, control, q, q_bar, fields, fields_bar):
        body(kernel, drive, drive_bar, control, q, q_bar, fields, fields_bar)

    return named(run, f"push_vjp_{kind.__name__}")


def starts_of(pieces: Sequence[Array]) -> tuple[Array, Array]:
    """Return where each piece begins in their concatenation (A + 1,), and the concatenation."""
    start = np.cumsum([0, *(len(piece) for piece in pieces)]).astype(np.int64)
    return start, np.concatenate([np.zeros(0, np.int64), *pieces]).astype(np.int64)
