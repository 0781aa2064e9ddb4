"""Unknowns as one flat vector: blocks named by their key paths, with bounds and a scale.

An optimizer sees x in [0, 1]: where a value lies between its bounds, on a linear or a logarithmic scale. So unknowns
with different units have the same size, and a step of 0.1 is a tenth of the range. The weights of a controller have no
unit and often no bounds, so they are not scaled.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cqrun.plugin.contract import Array

REGULARISER = "regulariser"
"""Name of the sum of all regularisers among the terms of a loss."""


@dataclass(frozen=True)
class Follower:
    """A value that follows an unknown: factor * value + offset, under another key path.

    `order` (n,) gives for each of its entries the index of the unknown's entry; None if the order is the same.
    """

    path: str
    factor: float
    offset: float
    order: Array | None = None

    def of(self, value: Array) -> Array:
        """Return the follower's value (n,) from the unknown's."""
        return np.asarray(self.factor * (value if self.order is None else value[self.order]) + self.offset)

    def of_vjp(self, bar: Array) -> Array:
        """Return the cotangent of the unknown's value from that of the follower's."""
        if self.order is None:
            return np.asarray(self.factor * bar)
        out = np.zeros(bar.shape)
        out[self.order] = self.factor * bar
        return out


@dataclass(frozen=True)
class Block:
    """One unknown: `size` numbers under one key path, with common bounds.

    `initial` has the shape of the value: () for one number, (n,) for one for each group or particle. `regulariser` is
    the weight of the mean of (s - s_0)^2 in a loss, where s is the scaled value and s_0 the scaled initial value.
    """

    path: str
    lower: float
    upper: float
    log: bool
    initial: Array
    followers: tuple[Follower, ...] = field(default=(), kw_only=True)
    regulariser: float = field(default=0.0, kw_only=True)

    @property
    def size(self) -> int:
        """Number of entries in x."""
        return int(self.initial.size)

    @property
    def ends(self) -> tuple[Array, Array]:
        """The smallest and largest x (size,)."""
        return np.zeros(self.size), np.ones(self.size)

    def to_scaled(self, value: Array) -> Array:
        """Return values on the scale of x."""
        value = np.asarray(value, float)
        if self.log:
            return np.asarray(np.log(value / self.lower) / np.log(self.upper / self.lower))
        return np.asarray((value - self.lower) / (self.upper - self.lower))

    def to_value(self, x: Array) -> Array:
        """Return the values for x; the bounds themselves are reproduced exactly."""
        if self.log:
            value = self.lower * np.exp(x * np.log(self.upper / self.lower))
        else:
            value = self.lower + x * (self.upper - self.lower)
        return np.asarray(np.clip(value, self.lower, self.upper))

    def slope(self, value: Array) -> Array:
        """Return d value / dx."""
        if self.log:
            return np.asarray(value * np.log(self.upper / self.lower))
        return np.full(np.shape(value), self.upper - self.lower)

    def pack(self, value: Array) -> Array:
        """Return x (size,) for a value."""
        return self.to_scaled(value).reshape(-1)

    def unpack(self, x: Array) -> Array:
        """Return the value for x (size,), in the shape of `initial`."""
        return self.to_value(x.reshape(self.initial.shape))

    def gradient(self, value: Array, bar: Array) -> Array:
        """Return the gradient by x (size,) from that by the value."""
        return np.asarray(bar * self.slope(value)).reshape(-1)

    def departure(self, value: Array) -> float:
        """Return the weighted regulariser of a value."""
        return float(self.regulariser * np.mean((self.to_scaled(value) - self.to_scaled(self.initial)) ** 2))

    def departure_vjp(self, value: Array, bar: float) -> Array:
        """Return the cotangent of a value from that of `departure`; a single number applies to all entries."""
        change = self.to_scaled(value) - self.to_scaled(self.initial)
        s_bar = 2.0 * bar * self.regulariser / np.size(change) * change
        return np.asarray((s_bar if np.ndim(value) else np.sum(s_bar)) / self.slope(value))

    def numbers(self, x: Array) -> Array:
        """Return x (size,) in the unknown's unit."""
        return self.unpack(x).reshape(-1)


@dataclass(frozen=True)
class Spread(Block):
    """A few numbers that determine a value for every particle: on the unknown's scale, value = spread x.

    The entries of `spread` (n, size) are not negative and its rows sum to 1 (`spread.py`), so all values keep the
    bounds.
    """

    spread: Any

    @property
    def size(self) -> int:
        """Number of entries in x."""
        return int(self.spread.shape[1])

    def pack(self, value: Array) -> Array:
        """Return x (size,) for a uniform value (n,), such as an initial one."""
        return np.full(self.size, self.to_scaled(value)[0])

    def unpack(self, x: Array) -> Array:
        """Return the value (n,) for x (size,)."""
        return self.to_value(self.spread @ x)

    def gradient(self, value: Array, bar: Array) -> Array:
        """Return the gradient by x (size,) from that by the value (n,)."""
        return np.asarray(self.spread.T @ (bar * self.slope(value)))

    def numbers(self, x: Array) -> Array:
        """Return x (size,) in the unknown's unit."""
        return self.to_value(x)


@dataclass(frozen=True)
class Plain(Block):
    """Numbers without scale, each between bounds that may be infinite."""

    lower: Any
    upper: Any

    @property
    def ends(self) -> tuple[Array, Array]:
        """The smallest and largest x (size,)."""
        return self._each(self.lower), self._each(self.upper)

    def _each(self, bound: Any) -> Array:
        return np.broadcast_to(np.asarray(bound, float), self.initial.shape).reshape(-1)

    def to_scaled(self, value: Array) -> Array:
        """Return the values themselves."""
        return np.asarray(value, float)

    def to_value(self, x: Array) -> Array:
        """Return x, clipped to the bounds."""
        return np.asarray(np.clip(x, self.lower, self.upper))

    def slope(self, value: Array) -> Array:
        """Return d value / dx: 1."""
        return np.ones(np.shape(value))


@dataclass(frozen=True)
class Params:
    """All unknowns: their blocks one after another in x (n,)."""

    blocks: tuple[Block, ...]

    @property
    def slices(self) -> dict[str, slice]:
        """Slice of each block in x, by path."""
        ends = np.cumsum([0, *(block.size for block in self.blocks)])
        return {block.path: slice(int(a), int(b)) for block, a, b in zip(self.blocks, ends[:-1], ends[1:], strict=True)}

    @property
    def start(self) -> Array:
        """The initial x (n,)."""
        return self.pack({block.path: block.initial for block in self.blocks})

    @property
    def start_values(self) -> dict[str, Array]:
        """The initial values by path, including those of followers."""
        values = {block.path: block.initial for block in self.blocks}
        return values | {f.path: f.of(b.initial) for b in self.blocks for f in b.followers}

    @property
    def bounds(self) -> tuple[Array, Array]:
        """The smallest and largest x (n,)."""
        ends = [block.ends for block in self.blocks]
        return _joined([low for low, _ in ends]), _joined([high for _, high in ends])

    def pack(self, values: Mapping[str, Array]) -> Array:
        """Return x (n,) for values by path."""
        return _joined([block.pack(values[block.path]) for block in self.blocks])

    def unpack(self, x: Array) -> dict[str, Array]:
        """Return values by path, including those of followers."""
        values = {b.path: b.unpack(x[part]) for b, part in zip(self.blocks, self.slices.values(), strict=True)}
        return values | {f.path: f.of(values[b.path]) for b in self.blocks for f in b.followers}

    def physical(self, x: Array) -> Array:
        """Return x in SI units (n,); for a spread, the numbers that determine the values."""
        return _joined([block.numbers(x[part]) for block, part in zip(self.blocks, self.slices.values(), strict=True)])

    def gradient(self, x: Array, by_value: Mapping[str, Array]) -> Array:
        """Return the gradient by x (n,) from that by values."""
        values = self.unpack(x)
        bars = {b.path: sum((f.of_vjp(by_value[f.path]) for f in b.followers), by_value[b.path]) for b in self.blocks}
        return _joined([b.gradient(values[b.path], np.asarray(bars[b.path])) for b in self.blocks])

    @property
    def regularised(self) -> bool:
        """Whether any unknown has a regulariser."""
        return any(block.regulariser for block in self.blocks)

    def departure(self, values: Mapping[str, Array]) -> float:
        """Return the sum of the regularisers for values by path."""
        return sum(block.departure(values[block.path]) for block in self.blocks)

    def departure_vjp(self, values: Mapping[str, Array], bar: float) -> dict[str, Array]:
        """Return the cotangents of values that have a regulariser, by path."""
        return {b.path: b.departure_vjp(values[b.path], bar) for b in self.blocks if b.regulariser}

    def describe(self, x: Array) -> str:
        """Return the values for x as text for messages."""
        parts = []
        for path, value in self.unpack(x).items():
            text = f"{float(value):.6g}" if value.ndim == 0 else f"{value.min():.6g} ... {value.max():.6g}"
            parts.append(f"{path} = {text}")
        return ", ".join(parts)

    def bounds_in_words(self, below: Array, above: Array) -> str:
        """Describe which blocks are at a bound, given which entries are at the lower and at the upper one (n,)."""
        parts = []
        for block, part in zip(self.blocks, self.slices.values(), strict=True):
            sides = []
            for side, at_bound, bound in (("lower", below[part], block.lower), ("upper", above[part], block.upper)):
                if at_bound.any():
                    what = f"{at_bound.size} numbers" if isinstance(block, Spread) else str(at_bound.size)
                    some = f"{int(at_bound.sum())} of {what} " if at_bound.size > 1 else ""
                    value = f", {float(bound):g}" if np.ndim(bound) == 0 else ""
                    sides.append(f"{some}at the {side}{value}")
            if sides:
                parts.append(f"{block.path} ({'; '.join(sides)})")
        return f"at their bounds: {', '.join(parts)}" if parts else "no unknown is at a bound"


def _joined(parts: Sequence[Array]) -> Array:
    return np.concatenate(parts) if parts else np.zeros(0)
