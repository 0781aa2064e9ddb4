"""The range of an observed quantity in a scene: it is scaled to [-1, 1] for the controller.

`auto` is the observer's default; null, or `raw`, leaves values as they are, as CQ1 does. `[low, high]` applies to
every entry; a list of such pairs gives one to each entry of a vector. Null is stored as `raw`, because a resolved
scene does not contain null values.
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
"""Type of a field for a range."""


def limits(chosen: Any, low: Array, high: Array) -> tuple[Array, Array]:
    """Return the lower and upper ends (size,) of a range; `low` and `high` (size,) are what `auto` means.

    Raises:
        UsageError: the number of pairs is not that of the entries.
    """
    if isinstance(chosen, str):
        return (low, high) if chosen == AUTO else (np.full(low.shape, -1.0), np.full(high.shape, 1.0))
    pairs = np.array(chosen)
    if pairs.ndim == 2 and len(pairs) != len(low):
        raise UsageError(f"a range has {len(pairs)} pairs [low, high] for {len(low)} entries; give {len(low)} or one")
    return tuple(np.broadcast_to(side, low.shape).copy() for side in np.moveaxis(pairs, -1, 0))  # type: ignore[return-value]
