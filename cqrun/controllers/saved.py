"""Controller files: a controller's parameters, and facts about them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.controllers.controller import ParameterBlock
from cqrun.errors import UsageError
from cqrun.observers.npz import not_numbers, read_arrays, write_arrays
from cqrun.plugin.contract import Array

FILE_KIND = "a controller file"
META = "meta"


def save_controller(path: Path, parameters: Mapping[str, Array], meta: Mapping[str, Any]) -> None:
    """Write parameters by name, and facts about them (`meta`, JSON), to an .npz file.

    Raises:
        OSError: writing fails.
    """
    write_arrays(path, {META: np.array(json.dumps(dict(meta), sort_keys=True, allow_nan=False)), **parameters})


def read_controller(path: Path) -> tuple[dict[str, Array], dict[str, Any]]:
    """Read the parameters of any controller by name, and the facts that were saved with them.

    Raises:
        UsageError: the file is not a controller file.
    """
    arrays = read_arrays(path, FILE_KIND)
    text = arrays.pop(META, np.zeros(0))
    if text.ndim or text.dtype.kind != "U":
        raise UsageError(f"{path}: is not {FILE_KIND}: it lacks the entry '{META}' that cqrun writes")
    try:
        return arrays, json.loads(text.item())
    except ValueError as error:
        raise UsageError(f"{path}: is not {FILE_KIND}: its entry '{META}' is not JSON: {error}") from error


def load_controller(path: Path, blocks: Sequence[ParameterBlock]) -> tuple[dict[str, Array], dict[str, Any]]:
    """Read the parameters of a controller with these blocks, and the facts that were saved with them.

    Raises:
        UsageError: the file is not a controller file, its arrays have other shapes, or a number is not finite.
    """
    arrays, meta = read_controller(path)
    shapes = {name: array.shape for name, array in arrays.items()}
    expected = {block.name: np.shape(block.initial) for block in blocks}
    if shapes != expected:
        raise UsageError(
            f"{path}: holds a controller of another shape: {_listed(shapes)}; this scene's has {_listed(expected)}: "
            "observers, actuators, controller and (open loop) control steps must be those it was trained with"
        )
    if bad := not_numbers(arrays):
        raise UsageError(f"{path}: {', '.join(bad)} of the controller are not finite numbers")
    return arrays, meta


def _listed(shapes: Mapping[str, tuple[int, ...]]) -> str:
    return ", ".join(f"{name} {' x '.join(map(str, shape)) or '1'}" for name, shape in shapes.items()) or "nothing"
