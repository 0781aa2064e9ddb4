"""Values by key path: the fields of a part that have them, and the cotangents of fields by key path."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from cqrun.plugin.contract import Array, is_differentiable

Values = Mapping[str, Array]
"""Key path -> value: one number (), one per group (G,), or one per particle (N,)."""


def numbers(path: str, defaults: list[float], values: Values) -> Array:
    """Return the values of the entries of a list; an entry without a value keeps its default."""
    return np.array([float(np.asarray(values.get(f"{path}.{k}", d)).reshape(-1)[0]) for k, d in enumerate(defaults)])


def updated(spec: Any, path: str, values: Values) -> Any:
    """Return a plug-in with its differentiable fields set to their values."""
    changes: dict[str, Any] = {}
    for name in type(spec).model_fields:
        if is_differentiable(type(spec), name):
            current = getattr(spec, name)
            if isinstance(current, list):
                changes[name] = numbers(f"{path}.{name}", current, values).tolist()
            elif f"{path}.{name}" in values:
                changes[name] = float(np.asarray(values[f"{path}.{name}"]).reshape(-1)[0])
    return spec.model_copy(update=changes)


def collect(path: str, cotangents: Mapping[str, Any], out: dict[str, Array]) -> None:
    """Add the cotangents of a part's fields (numbers or lists of numbers) to the gradients in `out`."""
    for name, cotangent in cotangents.items():
        base = f"{path}.{name}" if name else path
        entries = {base: cotangent} if np.ndim(cotangent) == 0 else {f"{base}.{k}": c for k, c in enumerate(cotangent)}
        for key, bar in entries.items():
            if key in out:
                out[key] += bar
