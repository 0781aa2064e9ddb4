"""Functions of NumPy, torch and jax with their derivatives: NumPy arrays in and out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from cqrun.errors import UsageError
from cqrun.explain import shown
from cqrun.plugin.contract import Array

Function = Callable[[Mapping[str, Array]], tuple[float, dict[str, Array]]]
"""Returns a value and its derivative by each array, by name."""


def differentiated(function: Callable[..., Any], names: Sequence[str], backend: str) -> Function:
    """Return a user's function of arrays, by their names, with its derivatives.

    Raises:
        UsageError: the package of the backend is missing; when called: the function returns something else.
    """
    return BACKENDS[backend](function, names)


def _of_numpy(function: Callable[..., Any], names: Sequence[str]) -> Function:
    def called(arrays: Mapping[str, Array]) -> tuple[float, dict[str, Array]]:
        result = function(*(arrays[name] for name in names))
        if not (isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], Mapping)):
            raise UsageError(
                f"loss: the function must return (loss, {{name: derivative}}), not {shown(result)}; or write it with "
                "torch or jax and give `backend`"
            )
        value, bars = result
        for name, bar in bars.items():
            if name not in names:
                raise UsageError(f"loss: the function returns a derivative by '{name}', which it does not take")
            if np.shape(bar) != arrays[name].shape:
                shapes = f"{np.shape(bar)}; the array has {arrays[name].shape}"
                raise UsageError(f"loss: the derivative by '{name}' has the shape {shapes}")
        return _number(value), {name: real(name, bar) for name, bar in bars.items()}

    return called


def _of_torch(function: Callable[..., Any], names: Sequence[str]) -> Function:
    torch = _package("torch")

    def called(arrays: Mapping[str, Array]) -> tuple[float, dict[str, Array]]:
        tensors = {name: torch.tensor(arrays[name], dtype=torch.float64, requires_grad=True) for name in names}
        value = function(*tensors.values())
        if not isinstance(value, torch.Tensor) or value.numel() != 1:
            raise UsageError(f"loss: the function must return a torch scalar, not {shown(value)}")
        if value.requires_grad:  # otherwise it does not depend on any array
            value.backward()
        bars = {name: tensor.grad.numpy() for name, tensor in tensors.items() if tensor.grad is not None}
        return _number(value.detach().item()), bars

    return called


def _of_jax(function: Callable[..., Any], names: Sequence[str]) -> Function:
    jax = _package("jax")
    places = tuple(range(len(names)))
    both = jax.value_and_grad(function, argnums=places)

    def called(arrays: Mapping[str, Array]) -> tuple[float, dict[str, Array]]:
        with jax.enable_x64(True):
            try:
                value, bars = both(*(jax.numpy.asarray(arrays[name], dtype="float64") for name in names))
            except TypeError as error:
                raise UsageError(f"loss: jax cannot differentiate the function: {error}") from error
            return _number(float(value)), {n: np.asarray(bar, float) for n, bar in zip(names, bars, strict=True)}

    return called


BACKENDS = {"numpy": _of_numpy, "torch": _of_torch, "jax": _of_jax}


def _package(name: str) -> Any:
    try:
        return __import__(name)
    except ImportError as error:
        message = f"loss: the backend '{name}' needs the package {name}: install it, `pip install {name}`"
        raise UsageError(message) from error


def real(name: str, bar: Any) -> Array:
    """Return a derivative as an array of numbers; raise UsageError for anything else."""
    array = np.asarray(bar)
    if array.dtype.kind not in "fiub":
        raise UsageError(f"loss: the derivative by '{name}' has no real numbers: it is of the type {array.dtype}")
    return array.astype(float)


def _number(value: Any) -> float:
    array = np.asarray(value)
    if array.ndim or array.dtype.kind not in "fiub":
        raise UsageError(f"loss: the function must return a single real number as the loss, not {shown(value)}")
    number = float(array)
    if not np.isfinite(number):
        raise UsageError(f"loss: the function returned {number}; a loss must be finite")
    return number
