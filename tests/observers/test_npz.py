"""Arrays in files: read only if the file has the bytes that it announces."""

from __future__ import annotations

import contextlib
import io
import os
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from cqrun.errors import UsageError
from cqrun.observers.npz import LARGEST, read_arrays, write_arrays


def header(shape: object, descr: str = "<f8", version: bytes = b"\x01\x00") -> bytes:
    text = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY" + version + len(text).to_bytes(2, "little") + text


def archive(path: Path, member: bytes, name: str = "a.npy", compression: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", compression) as file:
        file.writestr(name, member)
    return path


def refusal(path: Path) -> str:
    with pytest.raises(UsageError) as info:
        read_arrays(path, "a test file")
    return str(info.value)


def test_arrays_are_read_as_they_were_written(tmp_path: Path, rng: np.random.Generator) -> None:
    arrays = {"a": rng.normal(size=(3, 4)), "b": np.array("text"), "c": np.asfortranarray(rng.normal(size=(2, 5)))}
    write_arrays(tmp_path / "own.npz", arrays)
    np.savez_compressed(tmp_path / "packed.npz", **arrays)
    for name in ("own.npz", "packed.npz"):
        again = read_arrays(tmp_path / name, "a test file")
        assert again.keys() == arrays.keys()
        assert all(np.array_equal(again[key], arrays[key]) for key in arrays)


@pytest.mark.parametrize(
    "member",
    [
        header("(1000000000000,)") + bytes(8),
        header("(2000000000,)") + bytes(8),
        header("(1,)", "|V2000000000") + bytes(8),
        header("(3,)") + bytes(23),
        header("(3,)") + bytes(25),
        header("(-1, -3)") + bytes(24),
        header("(0, 1000000000000000000000000000000)"),
        header("(" + 70 * "1, " + ")") + bytes(8),
        header("(1,)", "|O") + bytes(8),
        header("(1,)", version=b"\x03\x00") + bytes(8),
        header(1000 * "(" + "1" + 1000 * ",)") + bytes(8),
        b"\x93NUMPY\x02\x00\xff\xff\xff\x7f{}",
        b"",
    ],
)
def test_array_of_other_bytes_than_announced_is_refused_before_it_is_made(member: bytes, tmp_path: Path) -> None:
    path = archive(tmp_path / "a.npz", member)
    tracemalloc.start()
    message = refusal(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert message == f"{path}: is not a test file: it is not an .npz file of arrays, or it is damaged"
    assert peak < 10_000_000


def test_file_that_unpacks_to_too_much_is_refused(tmp_path: Path) -> None:
    path = archive(tmp_path / "bomb.npz", header("(1000000,)") + bytes(8_000_000), compression=zipfile.ZIP_DEFLATED)
    read_arrays(path, "a test file")
    data = path.read_bytes()
    size = (8_000_000 + len(header("(1000000,)"))).to_bytes(4, "little")
    path.write_bytes(data.replace(size, (LARGEST + 1).to_bytes(4, "little")))
    assert refusal(path).endswith("is not a test file: it announces 1 GiB, but at most 1 GiB are read")


def test_other_files_are_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.npz")
    assert refusal(tmp_path / "pipe.npz").endswith(
        "cannot be read as a test file: it is a pipe or a device, not a file"
    )
    assert refusal(tmp_path).endswith("cannot be read as a test file: Is a directory")
    (tmp_path / "text.npz").write_text("a: 1")
    assert "is not an .npz file of arrays" in refusal(tmp_path / "text.npz")
    assert refusal(archive(tmp_path / "none.npz", b"", "notes.txt")).endswith("it contains no named arrays")


def test_damaged_files_are_refused_in_words(tmp_path: Path, rng: np.random.Generator) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, a=rng.normal(size=30), b=np.arange(5.0))
    whole = buffer.getvalue()
    path = tmp_path / "damaged.npz"
    for _ in range(200):
        data = bytearray(whole)
        for _ in range(rng.integers(1, 4)):
            data[rng.integers(len(data))] = rng.integers(256)
        path.write_bytes(data[: rng.integers(1, len(data))] if rng.random() < 0.2 else data)
        with contextlib.suppress(UsageError):
            assert all(isinstance(array, np.ndarray) for array in read_arrays(path, "a test file").values())
