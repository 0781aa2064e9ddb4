"""The axes of a sweep, as typed after `-s`, and the points that they span.

    key=a,b,c          these values, in YAML
    key=1:5:9          9 values from 1 to 5, evenly spaced
    key=1e4:1e6:log:7  7 values from 1e4 to 1e6, each the same factor larger than the one before
    key=1:5            a range, from which `--samples` draws; 1e4:1e6:log is drawn by its logarithm

Lists are combined with each other: the first axis changes slowest. Ranges are sampled together, by a Latin hypercube or
independently. Every combination of the lists gets the same samples.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from cqrun.errors import UsageError
from cqrun.explain import listed
from cqrun.plugin.contract import Array

Sampling = Literal["latin", "random"]

NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
RANGE = re.compile(rf"({NUMBER}):({NUMBER})(:log)?(?::(\d+))?")
BRACKETS = {"[": 1, "{": 1, "(": 1, "]": -1, "}": -1, ")": -1}

DIGITS = 6
"""Significant digits of the values of a range: enough for any use, and 0.3 is not 0.30000000000000004."""

MOST_POINTS = 10_000
"""More are a slip: each is a run of its own."""

Point = dict[str, str]
"""A point of a sweep: by key path, the value as YAML text."""


@dataclass(frozen=True)
class Axis:
    """An axis of a sweep: its values as YAML text, or the range from which they are drawn.

    Attributes:
        path: key path in the scene.
        values: the values; empty if they are drawn.
        ends: lower and upper end of a range.
        log: whether a range is that of the logarithm.
    """

    path: str
    values: tuple[str, ...] = ()
    ends: tuple[float, float] = (0.0, 0.0)
    log: bool = False

    def at(self, share: Array) -> list[str]:
        """Return the values at shares of the range (n,) from 0 to 1."""
        low, high = np.log(self.ends) if self.log else self.ends
        found = low + share * (high - low)
        return [_shown(value) for value in (np.exp(found) if self.log else found)]


def axis_of(text: str) -> Axis:
    """Return the axis that a text after `-s` describes; UsageError if it describes none."""
    path, equals, spec = (part.strip() for part in text.partition("="))
    if not (path and equals and spec):
        raise _wrong(text, "must be key=a,b,c or key=FROM:TO:COUNT")
    found = RANGE.fullmatch(spec)
    if found is None:
        return Axis(path, _list_of(text, spec))
    low, high, log, count = float(found[1]), float(found[2]), bool(found[3]), found[4]
    if low == high:
        raise _wrong(text, "its two ends are equal")
    if log and min(low, high) <= 0.0:
        raise _wrong(text, "a logarithmic range has positive ends")
    axis = Axis(path, (), (low, high), log)
    if count is None:
        return axis
    if not 2 <= int(count) <= MOST_POINTS:
        raise _wrong(text, f"a range has 2 to {MOST_POINTS:,} values, this one has {count}")
    return Axis(path, (_shown(low), *axis.at(np.linspace(0.0, 1.0, int(count)))[1:-1], _shown(high)))


def points_of(axes: Sequence[Axis], samples: int | None, sampling: Sampling = "latin", seed: int = 0) -> list[Point]:
    """Return the points of a sweep.

    Args:
        axes: at least one; none twice.
        samples: number of samples of the ranges; None if there are none.
        sampling: how ranges are sampled.
        seed: of the samples.

    Raises:
        UsageError: the axes and the number of samples do not fit together, or there are too many points.
    """
    names, ranges = [axis.path for axis in axes], [axis for axis in axes if not axis.values]
    lists = [axis for axis in axes if axis.values]
    if not axes:
        raise UsageError("a sweep needs an axis: give -s key=a,b,c or -s key=FROM:TO:COUNT, or --seeds N")
    if twice := [name for name in dict.fromkeys(names) if names.count(name) > 1]:
        raise UsageError(f"-s {twice[0]}=...: is given twice; put all its values into one")
    if ranges and samples is None:
        paths = listed([axis.path for axis in ranges])
        raise UsageError(
            f"-s {paths}: a range without a count is sampled: give --samples N, or a count (FROM:TO:COUNT)"
        )
    if samples is not None and not ranges:
        raise UsageError(f"--samples {samples}: there is no range to sample: give one, as -s key=FROM:TO")
    count = (samples or 1) * int(np.prod([len(axis.values) for axis in lists], dtype=object))
    if not 1 <= count <= MOST_POINTS:
        raise UsageError(f"a sweep has 1 to {MOST_POINTS:,} points, this one would have {count:,}")
    drawn = _drawn(ranges, samples or 1, sampling, seed)
    combinations = itertools.product(*(axis.values for axis in lists))
    return [
        {name: {**fixed, **sample}[name] for name in names}
        for values in combinations
        for fixed in [dict(zip((axis.path for axis in lists), values, strict=True))]
        for sample in drawn
    ]


def _drawn(ranges: Sequence[Axis], samples: int, sampling: Sampling, seed: int) -> list[Point]:
    """Return the samples of the ranges; one empty point if there are none."""
    if not ranges:
        return [{}]
    rng = np.random.default_rng(seed)
    if sampling == "latin":
        from scipy.stats import qmc

        shares = qmc.LatinHypercube(len(ranges), rng=rng).random(samples)
    else:
        shares = rng.random((samples, len(ranges)))
    columns = [axis.at(shares[:, k]) for k, axis in enumerate(ranges)]
    return [{axis.path: column[j] for axis, column in zip(ranges, columns, strict=True)} for j in range(samples)]


def _list_of(text: str, spec: str) -> tuple[str, ...]:
    """Return the items of a list: parts between commas that are not in brackets or quotes."""
    items, depth, quote = [""], 0, ""
    for sign in spec:
        quote = "" if sign == quote else sign if not quote and sign in "'\"" else quote
        depth += 0 if quote else BRACKETS.get(sign, 0)
        if sign == "," and depth == 0 and not quote:
            items.append("")
        else:
            items[-1] += sign
    values = tuple(item.strip() for item in items)
    if "" in values:
        raise _wrong(text, "has an empty value: separate values by one comma each")
    if len(set(map(_meant, values))) < len(values):
        raise _wrong(text, "has a value twice")
    return values


def _meant(value: str) -> str | float:
    """Return the number that a text is, so that 1e5 and 1.0e5 are the same; another text as it is."""
    try:
        return float(value)
    except ValueError:
        return value


def _shown(value: float) -> str:
    """Return a number as YAML text."""
    rounded = float(f"{value:.{DIGITS}g}")
    return repr(int(rounded)) if rounded.is_integer() and abs(rounded) < 1e15 else repr(rounded)


def _wrong(text: str, message: str) -> UsageError:
    return UsageError(f"-s {text}: {message}")
