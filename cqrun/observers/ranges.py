"""The range of an observed quantity, as a scene gives it: what becomes [-1, 1] for the controller.

`auto` is the plug-in's own choice; null, or `raw`, leaves values as they are, as CQ1 does; `[low, high]` serves
every entry, and a list of such pairs each entry of a vector. A null is kept as `raw`, because a resolved scene
does not write what is null.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import PlainValidator, WithJsonSchema

from cqrun.errors import UsageError
from cqrun.explain import shown
from cqrun.plugin.contract import Array

AUTO, RAW = "auto", "raw"

_PAIR = {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2}
_SCHEMA = {"anyOf": [{"enum": [AUTO, RAW]}, {"type": "null"}, _PAIR, {"type": "array", "items": _PAIR, "minItems": 1}]}


def _validated(value: Any) -> Any:
    """Return `auto`, `raw`, a pair, or a list of pairs."""
    if value is None or value in (AUTO, RAW):
        return value or RAW
    several = isinstance(value, list) and value and all(isinstance(part, list) for part in value)
    pairs = value if several else [value]
    if not all(_is_pair(pair) for pair in pairs):
        raise ValueError(
            "must be [low, high] with low < high, a list of such pairs, auto, or null (raw) for values as they are; "
            f"is {shown(value)}"
        )
    pairs = [[float(low), float(high)] for low, high in pairs]
    return pairs if several else pairs[0]


def _is_pair(value: Any) -> bool:
    numbers = isinstance(value, list) and len(value) == 2
    numbers = numbers and all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in value)
    return bool(numbers and np.isfinite(value).all() and value[0] < value[1])


Range = Annotated[Any, PlainValidator(_validated), WithJsonSchema(_SCHEMA)]
"""Type of a field that holds a range."""


def limits(given: Any, low: Array, high: Array) -> tuple[Array, Array]:
    """Return the lower and upper ends (size,) of a range; `low` and `high` (size,) are what `auto` means.

    Raises:
        UsageError: as many pairs as there are entries are wanted, and there are others.
    """
    if isinstance(given, str):
        return (low, high) if given == AUTO else (np.full(low.shape, -1.0), np.full(high.shape, 1.0))
    pairs = np.array(given)
    if pairs.ndim == 2 and len(pairs) != len(low):
        raise UsageError(f"a range has {len(pairs)} pairs [low, high] for {len(low)} entries; give {len(low)} or one")
    return tuple(np.broadcast_to(side, low.shape).copy() for side in np.moveaxis(pairs, -1, 0))  # type: ignore[return-value]
