"""The header and the parameter section of a C3D file, each claim checked against what the file holds.

    header       block of the parameters:u1 0x50:u1 points:u2 analog:u2 first:u2 last:u2 gap:u2 scale:f4 data:u2 ...
    parameters   2 bytes, blocks:u1 processor:u1, then entries
    entry        length of name:i1 group:i1 name distance to the next entry:u2; if `group` > 0 a parameter follows:
                 kind:i1 (-1 text, 1, 2 or 4 bytes a number) dimensions:u1 size:u1* values description

Nothing is allocated for a claim, so a damaged file ends in a message and not in the memory of the machine. The format
is described at https://www.c3d.org.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from cqrun.errors import DataError
from cqrun.plugin.contract import Array

BLOCK = 512
INTEL, DEC, MIPS = 84, 85, 86
_MAGIC = 0x50
_MANY = 0xFFFF
"""The last frame in the header of a file with more frames than it can count."""

_NUMBERS = {1: "B", 2: "H"}
_AGAIN = "copy or export it again"
_SAME = 1e-3
"""Largest difference of two numbers that are the same, as a part of them."""


@dataclass(frozen=True)
class Head:
    """What a C3D file says of its data.

    Attributes:
        processor: INTEL, DEC or MIPS, whose numbers the file has.
        points: markers in each frame.
        analog: analog samples after the markers of each frame.
        frames: how many frames the file promises; None if it does not say.
        scale: coordinates of a marker are whole multiples of it; if it is negative, they are floats.
        rate: frames per second [Hz].
        start: place of the first frame in the file.
        units: of coordinates, as the file names them.
        labels: names of the markers.
    """

    processor: int
    points: int
    analog: int
    frames: int | None
    scale: float
    rate: float
    start: int
    units: str
    labels: tuple[str, ...]

    @property
    def order(self) -> str:
        """Order of the bytes in a number."""
        return _order(self.processor)


def read_head(data: bytes, source: str) -> Head:
    """Return what a C3D file says of its data.

    Raises:
        DataError: the file is not C3D, is truncated, or contradicts itself.
    """
    begin, processor = _section(data, source)
    order = _order(processor)
    try:
        points, analog, first, last = struct.unpack_from(f"{order}4H", data, 2)
        scale, rate = (_real(data, at, processor) for at in (12, 20))
        start = BLOCK * (struct.unpack_from(f"{order}H", data, 16)[0] - 1)
        parameters = Parameters(data[begin : max(start, begin)], processor)
        point = {"USED": parameters.values("POINT:USED")[0]}  # every file has it
        point |= {key: parameters.first(f"POINT:{key}", 0) for key in ("SCALE", "RATE")}
        _require_same("number of markers", points, point["USED"], source)
        points = points or int(point["USED"])
        _require_same("frame rate", rate, point["RATE"], source)
        _require_same("scale", math.copysign(1.0, scale), math.copysign(1.0, point["SCALE"] or scale), source)
        labels = tuple(_labels(parameters, points))
        return Head(
            processor, points, analog, _frames(first, last, parameters), float(point["SCALE"] or scale),
            float(point["RATE"] or rate), start, str(parameters.first("POINT:UNITS", "")), labels,
        )  # fmt: skip
    except (struct.error, LookupError, TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{source}: its header or its parameter section is damaged; {_AGAIN}") from error


class Parameters:
    """The parameter section of a file; values are read where they are asked for.

    Args:
        section: from its first byte to the data.
        processor: INTEL, DEC or MIPS.
    """

    def __init__(self, section: bytes, processor: int) -> None:
        self._section, self._processor = section, processor
        self._places = dict(_entries(section, _order(processor)))

    def values(self, name: str) -> list[Any]:
        """Return the values of a parameter such as `POINT:LABELS`: numbers, or texts without blanks at their ends."""
        if name not in self._places:
            return []
        section, at = self._section, self._places[name]
        kind, dimensions = struct.unpack_from("bB", section, at)
        sizes = struct.unpack_from(f"{dimensions}B", section, at + 2)
        count, at = math.prod(sizes), at + 2 + dimensions
        if at + count * abs(kind) > len(section):
            raise IndexError(f"{name} reaches beyond the parameter section")
        if kind == -1:
            width = sizes[0] if sizes else 1
            return [_text(section[k : k + width]) for k in range(at, at + count, max(width, 1))]
        if kind == 4:
            return [_real(section, at + 4 * k, self._processor) for k in range(count)]
        return list(struct.unpack_from(f"{_order(self._processor)}{count}{_NUMBERS[kind]}", section, at))

    def first(self, name: str, default: Any) -> Any:
        """Return the first value of a parameter, or `default` if it is absent or empty."""
        return next(iter(self.values(name)), default)


def _section(data: bytes, source: str) -> tuple[int, int]:
    """Return where the parameters begin, and the processor; refuse a file that is not C3D or ends before its data."""
    first = data[0] if data else 0
    if len(data) < 2 or data[1] != _MAGIC or first < 2:
        raise DataError(f"{source}: not a C3D file (its second byte is not 0x50)")
    begin = (first - 1) * BLOCK
    if len(data) < begin + 4:
        raise DataError(f"{source}: truncated: the file ends before its parameters; {_AGAIN}")
    blocks, processor = data[begin + 2], data[begin + 3]
    if processor not in (INTEL, DEC, MIPS):
        raise DataError(f"{source}: not a C3D file (processor type {processor} is not 84, 85 or 86)")
    if len(data) < begin + blocks * BLOCK:
        raise DataError(f"{source}: truncated: the file ends inside its parameters; {_AGAIN}")
    return begin, processor


def _entries(section: bytes, order: str) -> Iterator[tuple[str, int]]:
    """Yield the name of each parameter, `GROUP:NAME`, and where its kind stands in the section."""
    groups, found, at, distance = {}, [], 4, 1
    while distance:
        length, group = struct.unpack_from("bb", section, at)
        if length == 0:
            break
        name, at = section[at + 2 : at + 2 + abs(length)].decode("latin-1").upper(), at + 2 + abs(length)
        (distance,) = struct.unpack_from(f"{order}H", section, at)
        if group < 0:
            groups[-group] = name
        else:
            found.append((group, name, at + 2))
        at += distance  # at least 1: the chain ends with the section
    yield from ((f"{groups.get(group, '')}:{name}", place) for group, name, place in found)


def _frames(first: int, last: int, parameters: Parameters) -> int | None:
    """Return how many frames a file promises; the header cannot count more than 65,534."""
    long_frames = int(parameters.first("POINT:LONG_FRAMES", 0))
    if last != _MANY and last >= first:
        return max(last - first + 1, long_frames)
    begin, end = (parameters.values(f"TRIAL:ACTUAL_{which}_FIELD") for which in ("START", "END"))
    if long_frames == 0 and len(begin) == len(end) == 2:
        long_frames = (end[0] + (end[1] << 16)) - (begin[0] + (begin[1] << 16)) + 1
    return long_frames if long_frames > 0 else None


def _labels(parameters: Parameters, count: int) -> Iterator[str]:
    """Yield the labels of all markers; files with more than 255 continue in LABELS2, LABELS3, ..."""
    labels = [
        label
        for suffix in ("", *(str(k) for k in range(2, 2 + count // 255 + 1)))
        for label in parameters.values(f"POINT:LABELS{suffix}")
    ]
    yield from labels[:count]
    yield from (f"unlabelled {k}" for k in range(len(labels), count))


def _require_same(what: str, header: float, parameter: float, source: str) -> None:
    """Refuse a file whose header and parameter section both say a number, and not the same."""
    if header and parameter and not abs(header - parameter) <= _SAME * abs(header):
        raise DataError(
            f"{source}: its header says another {what} ({header:g}) than its parameter section ({parameter:g}): "
            f"the file is damaged; {_AGAIN}"
        )


def _text(raw: bytes) -> str:
    try:
        return raw.decode("utf-8").strip(" \0")
    except UnicodeDecodeError:
        return raw.decode("latin-1").strip(" \0")


def _real(data: bytes, at: int, processor: int) -> float:
    (raw,) = struct.unpack_from(f"{_order(processor)}I", data, at)
    return float(reals(np.array([raw], np.uint32), processor)[0])


def reals(raw: Array, processor: int) -> Array:
    """Return numbers of 4 bytes, given as unsigned integers, as floats; NaN and infinities stay what they are.

    A number of DEC's has its halves exchanged, and its exponent counts from 129 where IEEE's counts from 127.
    """
    raw = raw.astype(np.uint32)
    with np.errstate(invalid="ignore"):  # a signalling NaN of a damaged file
        if processor != DEC:
            return np.asarray(raw.view(np.float32).astype(float))
        return np.asarray(((raw << 16) | (raw >> 16)).view(np.float32).astype(float) / 4.0)


def _order(processor: int) -> str:
    return ">" if processor == MIPS else "<"
