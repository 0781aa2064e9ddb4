"""The replay log: every evaluation of an optimizer that cannot save its state.

The file is a list of records; each is appended with fsync and has a CRC-32 checksum. A resumed optimizer requests the
same evaluations in the same order. The log answers as long as the requested point matches the logged one: bit for bit
on the same machine, and within round-off on another one, whose linear algebra may sum in another order. After that,
evaluations are computed again.

    file     "CQREPLAY" version:u4 record*
    record   length:u4 crc32:u4 payload
    payload  kind:16s status:u1 arrays:u1 message_length:u4 message array*      first array: x
    array    name:16s dimensions:u1 size:u8* values:f8*                         all little-endian
"""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from cqrun.disk import open_file, sync_directory
from cqrun.errors import UsageError
from cqrun.optimizers.base import TrialFailed
from cqrun.plugin.contract import Array
from cqrun.store.atomic import append_durably, disk_errors

MAGIC = b"CQREPLAY" + struct.pack("<I", 1)
FRAME = struct.Struct("<II")
HEAD = struct.Struct("<16sBBI")
ARRAY = struct.Struct("<16sB")
OK, FAILED = 0, 1
QUESTION = "x"

ROUND_OFF = 1e-9
"""Largest distance from a logged point, divided by 1 + its size, that counts as round-off of another machine.

Round-off is about 1e-16 in the first evaluations of a solver, and more after many. Two trials that a solver
distinguishes are farther apart.
"""


class ReplayLog:
    """Answers evaluations from a file, and appends new ones.

    Args:
        path: the file; it is made if it does not exist.
        note: called with a sentence when the log is cut.

    Attributes:
        replayed: number of evaluations answered from the file since it was opened.
        computed: number of evaluations that were computed and appended.

    Raises:
        UsageError: the file exists and is not a replay log.
    """

    def __init__(self, path: Path, note: Callable[[str], None] = lambda text: None) -> None:
        self.path, self._note = path, note
        self.replayed = self.computed = 0
        with disk_errors(path):
            fresh = not path.exists() or path.stat().st_size < len(MAGIC)
            self._file = open_file(path, "w+b" if fresh else "r+b", buffering=0)
            if fresh:
                append_durably(self._file, MAGIC)
                sync_directory(path.parent)
            self._file.seek(0)
            magic = self._file.read(len(MAGIC))
        if magic != MAGIC:
            self._file.close()
            raise UsageError(
                f"{path}: unreadable checkpoint: not a replay log of this version of cqrun; "
                "start the run over with --fresh"
            )
        self._end = len(MAGIC)
        self._live = False
        self._rounded = False

    def evaluate(self, kind: str, x: Array, compute: Callable[[], dict[str, Array]]) -> dict[str, Array]:
        """Return float64 arrays by name, from the log if its next record is this evaluation, or else computed.

        Args:
            kind: name of the evaluation, at most 16 characters.
            x: point of the evaluation (n,).
            compute: computes the answer; it may raise TrialFailed, which is logged and replayed.

        Raises:
            TrialFailed: the trial failed, now or when it was logged.
            RunError: the record cannot be written.
        """
        if not self._live:
            payload = self._next_payload()
            distance = np.inf if payload is None else _distance(payload, kind, x)
            if payload is not None and distance <= ROUND_OFF:
                self._end = self._file.tell()
                self.replayed += 1
                self._note_rounding(distance)
                return _answer(payload)
            if payload is not None:
                self._note(
                    f"{self.path.name}: evaluation {self.replayed + 1} ({kind}) is at another point than the "
                    "logged one; the rest of the log is dropped and computed again"
                )
            self._go_live()
        return self._compute(kind, x, compute)

    def _note_rounding(self, distance: float) -> None:
        if distance > 0.0 and not self._rounded:
            self._rounded = True
            self._note(
                f"{self.path.name}: evaluation {self.replayed} is {distance:.1g} from the logged point: the log was "
                "written on a machine that rounds differently; its answers are used, and last digits may differ from "
                "here on"
            )

    def close(self) -> None:
        """Close the file; the log remains."""
        self._file.close()

    def _compute(self, kind: str, x: Array, compute: Callable[[], dict[str, Array]]) -> dict[str, Array]:
        question = np.array(x, dtype=np.float64)  # compute may change x
        try:
            answer = {name: np.array(value, dtype=np.float64) for name, value in compute().items()}
        except TrialFailed as failure:
            self._append(_pack(kind, FAILED, _failure_text(failure), {QUESTION: question}))
            raise
        self._append(_pack(kind, OK, "", {QUESTION: question} | answer))
        return answer

    def _next_payload(self) -> bytes | None:
        """Return the record at the cursor, or None at the end of the file or if the record is incomplete or damaged."""
        self._file.seek(self._end)
        frame = self._file.read(FRAME.size)
        if not frame:
            return None
        if len(frame) == FRAME.size:
            length, crc = FRAME.unpack(frame)
            available = self.path.stat().st_size - self._file.tell()
            payload = self._file.read(length) if length <= available else b""
            if len(payload) == length >= HEAD.size and zlib.crc32(payload) == crc:
                return payload
        self._note(f"{self.path.name}: record {self.replayed + 1} is torn; it is computed again")
        return None

    def _go_live(self) -> None:
        with disk_errors(self.path):
            self._file.truncate(self._end)
            os.fsync(self._file.fileno())
        self._live = True

    def _append(self, payload: bytes) -> None:
        with disk_errors(self.path):
            self._file.seek(self._end)
            append_durably(self._file, FRAME.pack(len(payload), zlib.crc32(payload)) + payload)
        self._end = self._file.tell()
        self.computed += 1


def _label(text: str) -> bytes:
    data = text.encode()
    if len(data) > 16:
        raise ValueError(f"'{text}' is longer than the 16 bytes of a record's label")
    return data.ljust(16, b"\0")


def _pack(kind: str, status: int, message: str, arrays: dict[str, Array]) -> bytes:
    text = message.encode()
    parts = [HEAD.pack(_label(kind), status, len(arrays), len(text)), text]
    for name, array in arrays.items():
        parts.append(ARRAY.pack(_label(name), array.ndim) + struct.pack(f"<{array.ndim}Q", *array.shape))
        parts.append(array.astype("<f8").tobytes())
    return b"".join(parts)


def _unpack(payload: bytes) -> tuple[str, int, str, dict[str, Array]]:
    label, status, count, length = HEAD.unpack_from(payload)
    at = HEAD.size + length
    message = payload[HEAD.size : at].decode()
    arrays: dict[str, Array] = {}
    for _ in range(count):
        name, ndim = ARRAY.unpack_from(payload, at)
        at += ARRAY.size
        shape = struct.unpack_from(f"<{ndim}Q", payload, at)
        at += 8 * ndim
        size = int(np.prod(shape, dtype=np.int64))
        values = np.frombuffer(payload, dtype="<f8", count=size, offset=at)
        at += 8 * size
        arrays[name.rstrip(b"\0").decode()] = values.astype(np.float64).reshape(shape)
    return label.rstrip(b"\0").decode(), status, message, arrays


def _distance(payload: bytes, kind: str, x: Array) -> float:
    """Return the largest |x - logged| / (1 + |logged|): 0 if bit-for-bit equal, infinity for another kind or shape."""
    logged_kind, _, _, arrays = _unpack(payload)
    logged, asked = arrays[QUESTION], np.asarray(x, np.float64)
    if logged_kind != kind or logged.shape != asked.shape:
        return np.inf
    if logged.tobytes() == asked.tobytes():
        return 0.0
    # -0 and 0 are different bits at distance 0
    return max(float(np.max(np.abs(asked - logged) / (1.0 + np.abs(logged)))), float(np.finfo(float).tiny))


def _answer(payload: bytes) -> dict[str, Array]:
    _, status, message, arrays = _unpack(payload)
    if status == FAILED:
        raise TrialFailed(**json.loads(message))
    return {name: array for name, array in arrays.items() if name != QUESTION}


def _failure_text(failure: TrialFailed) -> str:
    return json.dumps(vars(failure))
