"""Numbers in HDF5 files: what a dataset claims is compared with what the file holds before anything is allocated."""

from __future__ import annotations

import math
import os
import re
import struct
import zlib
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cqrun.plugin.contract import Array
from cqrun.units import format_bytes

if TYPE_CHECKING:
    import h5py

UNREADABLE = (OSError, LookupError, ValueError, TypeError, AttributeError, RuntimeError, ArithmeticError)
"""What h5py raises for a damaged file, and what is raised where its content is not as expected."""

EXPANSION = 1032
"""Largest factor by which deflate, the compression in these files, makes data smaller."""

LARGEST_BLOCK, HANDY_BLOCK = 1 << 29, 1 << 24
"""Size of the frames that are read at once [bytes]: the limit, and the size for files with smaller chunks."""

HEAP = b"GCOL\1\0\0\0"
_ENDS = 1 << 24
_OBJECT = struct.Struct("<HHIQ")


def require_sound_heaps(path: Path) -> None:
    """Refuse a file whose heaps of texts are damaged, because HDF5 would look for their end for ever.

    A heap is `GCOL`, its version:u4, its size:u8, then objects: index:u2 count:u2 0:u4 size:u8 content. The object with
    index 0 is the free rest, and its size counts its own head. Heaps lie before the frames or behind them.

    Raises:
        UNREADABLE: a heap is damaged.
    """
    with path.open("rb") as file:
        end = file.seek(0, os.SEEK_END)
        for begin in sorted({0, max(0, end - _ENDS)}):
            file.seek(begin)
            for found in re.finditer(re.escape(HEAP), file.read(_ENDS)):
                at = begin + found.start()
                file.seek(at + len(HEAP))
                (size,) = struct.unpack("<Q", file.read(8).ljust(8, b"\0"))
                if at % 8 == 0 and not (16 <= size <= min(end - at, _ENDS) and _is_sound(file.read(size - 16))):
                    raise ValueError("a heap of texts is damaged")


def _is_sound(objects: bytes) -> bool:
    """Say whether the objects of a heap follow each other to its end."""
    at = 0
    while len(objects) - at >= _OBJECT.size:
        index, _, _, size = _OBJECT.unpack_from(objects, at)
        step = _OBJECT.size + -(-size // 8) * 8 if index else size
        if not _OBJECT.size <= step <= len(objects) - at:
            return False
        at += step
    return True


def text(node: h5py.Group, name: str) -> str:
    """Return a text among the attributes of a file or a group.

    Raises:
        UNREADABLE: there is none, or it is something else.
    """
    import h5py

    attribute = node.attrs.get_id(name)
    if attribute.shape != () or h5py.check_string_dtype(attribute.dtype) is None:
        raise ValueError(f"the attribute '{name}' is no text")
    return str(node.attrs[name])


def member(group: h5py.Group, name: str) -> Any:
    """Return an object in a group, or None.

    Raises:
        UNREADABLE: it is a link. A link can lead to another file, so it is not followed.
    """
    import h5py

    for part in name.split("/"):
        link = group.get(part, getlink=True) if isinstance(group, h5py.Group) else None
        if link is None:
            return None
        if not isinstance(link, h5py.HardLink):
            raise ValueError(f"'{name}' is a link, perhaps to another file")
        group = group[part]
    return group


def numbers(group: h5py.Group, name: str) -> h5py.Dataset:
    """Return a dataset of numbers.

    Raises:
        UNREADABLE: there is none, it is in another file, or it claims more than the file holds.
    """
    import h5py

    data = member(group, name)
    if not isinstance(data, h5py.Dataset) or data.dtype.kind not in "iuf" or data.shape is None:
        raise ValueError(f"'{name}' is no array of numbers")
    if data.is_virtual or data.external:
        raise ValueError(f"the numbers of '{name}' are in another file")
    if data.chunks:
        _require_handy(math.prod(data.chunks) * data.dtype.itemsize)
    claimed, held = data.size * data.dtype.itemsize, data.id.get_storage_size()
    if claimed > held * (EXPANSION if data.chunks else 1):
        raise ValueError(f"'{name}' claims {format_bytes(claimed)}, and the file holds {format_bytes(held)} of it")
    return data


def checksum(frame: Array) -> int:
    """Return the CRC-32 of a frame's type and numbers."""
    return zlib.crc32(frame.tobytes(), zlib.crc32(frame.dtype.str.encode()))


def write_rows(file: h5py.File, place: str, array: Array, unit: str) -> None:
    """Write an array with its unit, and the checksum of each of its rows."""
    rows = np.ascontiguousarray(array, "f8")
    file[place] = rows
    file[place].attrs["unit"] = unit
    file[f"checksums/{place}"] = np.array([checksum(row) for row in rows], np.uint32)


def read_rows(file: h5py.File, place: str, rows: int | None = None) -> Array:
    """Return an array that `write_rows` has written, with this number of rows.

    Raises:
        ValueError: it is not what was written.
    """
    array: Array = numbers(file, place)[:]
    sums = numbers(file, f"checksums/{place}")[:]
    if len(sums) != len(array) or rows not in (None, len(array)):
        raise ValueError(f"'{place}' has {len(array)} control steps of {rows or len(sums)}")
    for number, row in enumerate(array):
        if checksum(row) != sums[number]:
            raise ValueError(f"control step {number} of '{place}' is not what was written")
    return array


def require_stored_zeros(data: h5py.Dataset, first: int, frames: Array) -> None:
    """Refuse frames (T, ...) of a dataset, the first one's number is given, that are zero and are not stored as zeros.

    HDF5 reads zeros for chunks that a damaged index has lost; the index has no checksum, only the chunks have one.
    """
    if data.chunks is None:
        return
    steps = (range(0, length, step) for length, step in zip(frames.shape[1:], data.chunks[1:], strict=True))
    within = [(begin, tuple(map(slice, begin, np.add(begin, data.chunks[1:])))) for begin in product(*steps)]
    for number, frame in enumerate(frames):
        for begin, part in within:
            if not frame[part].any() and any(zlib.decompress(data.id.read_direct_chunk((first + number, *begin))[1])):
                raise ValueError(f"the index of '{data.name}' is damaged")


def blocks(data: h5py.Dataset) -> Iterator[tuple[slice, Array]]:
    """Yield the frames of a dataset (T, ...) in blocks that fit its chunks, so that each chunk is unpacked once.

    Raises:
        UNREADABLE: the chunks are too large to be read, or damaged.
    """
    frames = data.shape[0]
    one = max(1, data.size * data.dtype.itemsize // max(frames, 1))
    together = data.chunks[0] if data.chunks else 1
    _require_handy(together * one)
    step = max(1, HANDY_BLOCK // (together * one)) * together
    for begin in range(0, frames, step):
        part = slice(begin, min(begin + step, frames))
        yield part, data[part]


def _require_handy(size: int) -> None:
    """Refuse a block of a dataset that is too large to be read at once [bytes]."""
    if size > LARGEST_BLOCK:
        most = format_bytes(LARGEST_BLOCK)
        raise ValueError(f"its chunks are of {format_bytes(size)}, and at most {most} can be read at once (h5repack)")
