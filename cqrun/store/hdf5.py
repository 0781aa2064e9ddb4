"""Numbers in HDF5 files: what a dataset claims is compared with what the file holds before anything is allocated."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from cqrun.plugin.contract import Array
from cqrun.units import format_bytes

if TYPE_CHECKING:
    import h5py

UNREADABLE = (OSError, LookupError, ValueError, TypeError, AttributeError, RuntimeError)
"""What h5py raises for a damaged file, and what is raised where its content is not as expected."""

EXPANSION = 1032
"""Largest factor by which deflate, the compression in these files, makes data smaller."""

LARGEST_BLOCK, HANDY_BLOCK = 1 << 29, 1 << 24
"""Of the frames that are read at once [bytes]: at most, and where the file does not ask for more."""


def numbers(group: h5py.Group, name: str) -> h5py.Dataset:
    """Return a dataset of numbers.

    Raises:
        UNREADABLE: there is none, or it claims more than the file holds.
    """
    import h5py

    data = group[name]
    if not isinstance(data, h5py.Dataset) or data.dtype.kind not in "iuf" or data.shape is None:
        raise ValueError(f"'{name}' is no array of numbers")
    claimed, held = data.size * data.dtype.itemsize, data.id.get_storage_size()
    if claimed > held * (EXPANSION if data.chunks else 1):
        raise ValueError(f"'{name}' claims {format_bytes(claimed)}, and the file holds {format_bytes(held)} of it")
    return data


def blocks(data: h5py.Dataset) -> Iterator[tuple[slice, Array]]:
    """Yield the frames of a dataset (T, ...) in blocks that fit its chunks, so that each chunk is unpacked once.

    Raises:
        UNREADABLE: the chunks are too large to be read, or damaged.
    """
    frames = data.shape[0]
    one = max(1, data.size * data.dtype.itemsize // max(frames, 1))
    together = data.chunks[0] if data.chunks else 1
    if together * one > LARGEST_BLOCK:
        size, most = format_bytes(together * one), format_bytes(LARGEST_BLOCK)
        raise ValueError(f"its chunks are of {size}, and at most {most} can be read at once: repack it (h5repack)")
    step = max(1, HANDY_BLOCK // (together * one)) * together
    for begin in range(0, frames, step):
        part = slice(begin, min(begin + step, frames))
        yield part, data[part]
