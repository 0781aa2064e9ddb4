"""Named arrays in one .npz file, which is written whole or not at all."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.lib import format as numpy_format

from cqrun.disk import replacing
from cqrun.errors import UsageError
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import why_unreadable
from cqrun.units import format_bytes

LARGEST = 2**30
"""Largest amount of arrays that a file may hold [bytes]; those of controllers and encoders take a few MB."""


def write_arrays(path: Path, arrays: Mapping[str, Array]) -> None:
    """Write arrays to `path`, so that a reader sees the old file or the new one; OSError if that fails."""
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def read_arrays(path: Path, what: str) -> dict[str, Array]:
    """Read the arrays in the file at `path`; nothing in the file is executed.

    An array is read only if the file has the bytes that its header announces.

    Args:
        what: kind of file for error messages, such as "a controller file".

    Raises:
        UsageError: there is no such file, or it does not contain arrays.
    """
    if why := why_unreadable(path):
        raise UsageError(f"{path}: cannot be read as {what}: {why}")
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            size = sum(member.file_size for member in members)
            if size > LARGEST:
                raise UsageError(
                    f"{path}: is not {what}: it announces {format_bytes(size)}, but at most {format_bytes(LARGEST)} "
                    "are read"
                )
            if not members or any(not member.filename.endswith(".npy") for member in members):
                raise UsageError(f"{path}: is not {what}: it contains no named arrays")
            return {member.filename.removesuffix(".npy"): _array(archive.read(member)) for member in members}
    except UsageError:
        raise
    except OSError as error:
        raise UsageError(f"{path}: cannot be read as {what}: {error.strerror or error}") from error
    except Exception as error:  # both readers raise many kinds of errors for a damaged file
        raise UsageError(f"{path}: is not {what}: it is not an .npz file of arrays, or it is damaged") from error


def _array(data: bytes) -> Array:
    """Return the array in the bytes of an .npy file; ValueError if these are not as many as its header announces."""
    stream = io.BytesIO(data)
    version = numpy_format.read_magic(stream)
    header = {(1, 0): numpy_format.read_array_header_1_0, (2, 0): numpy_format.read_array_header_2_0}[version]
    shape, _, dtype = header(stream)
    if math.prod(shape) * dtype.itemsize != len(data) - stream.tell():
        raise ValueError(f"{shape} of {dtype} in {len(data) - stream.tell()} bytes")
    stream.seek(0)
    return np.asarray(numpy_format.read_array(stream, allow_pickle=False))


def not_numbers(arrays: Mapping[str, Array]) -> list[str]:
    """Return the names of the arrays that hold anything but finite numbers."""
    return [name for name, array in arrays.items() if array.dtype.kind != "f" or not np.isfinite(array).all()]
