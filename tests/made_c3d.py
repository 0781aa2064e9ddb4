"""C3D files: as ezc3d writes them, and by hand with the numbers of each processor and with whole coordinates."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import ezc3d
import numpy as np

INTEL, DEC, MIPS = 84, 85, 86


def write_c3d(
    path: Path, positions: np.ndarray, *, rate: float = 100.0, units: str = "m", names: Sequence[str],
    residuals: np.ndarray | None = None,
) -> Path:  # fmt: skip
    """Write (T, M, 3) positions with ezc3d."""
    frames, markers, _ = positions.shape
    content: Any = ezc3d.c3d()
    point = content["parameters"]["POINT"]
    point["UNITS"]["value"], point["RATE"]["value"], point["LABELS"]["value"] = [units], [rate], list(names)
    points = np.ones((4, markers, frames))
    points[:3] = positions.transpose(2, 1, 0)
    content["data"]["points"] = points
    if residuals is not None:
        masks = np.zeros((7, markers, frames), dtype=bool)
        content["data"]["meta_points"] = {"residuals": residuals.T[None], "camera_masks": masks}
    content.write(str(path))
    return path


class Numbers:
    """The numbers of a processor, as bytes."""

    def __init__(self, processor: int) -> None:
        self.processor, self.order = processor, ">" if processor == MIPS else "<"

    def words(self, *values: int) -> bytes:
        return struct.pack(f"{self.order}{len(values)}H", *(value & 0xFFFF for value in values))

    def reals(self, values: Any) -> bytes:
        values = np.asarray(values, dtype=float).ravel()
        if self.processor != DEC:
            return values.astype(f"{self.order}f4").tobytes()
        raw = (4.0 * values).astype("<f4").view("<u4")
        return ((raw << 16) | (raw >> 16)).astype("<u4").tobytes()


def hand_made(
    path: Path, positions: np.ndarray, *, processor: int = INTEL, scale: float = -0.001, rate: float = 100.0,
    units: str = "mm", names: Sequence[str], first: int = 1, analog: int = 0, header: dict[str, Any] | None = None,
    parameters: dict[str, tuple[int, Sequence[int], bytes]] | None = None,
) -> Path:  # fmt: skip
    """Write (T, M, 3) positions, NaN where not seen, in floats if `scale` is negative and else in multiples of it.

    Args:
        header: what stands there in place of `points`, `scale`, `rate`, `last` and `data`.
        parameters: kind, sizes and bytes by `GROUP:NAME`, beside those that every file has or in their place.
    """
    numbers, (frames, markers, _) = Numbers(processor), positions.shape
    given = {
        "POINT:USED": (2, (), numbers.words(markers)),
        "POINT:SCALE": (4, (), numbers.reals(scale)),
        "POINT:RATE": (4, (), numbers.reals(rate)),
        "POINT:UNITS": (-1, (len(units),), units.encode()),
        "POINT:LABELS": (-1, (16, markers), b"".join(name.encode().ljust(16) for name in names)),
        **(parameters or {}),
    }
    section = _section(given, numbers)
    told = {"points": markers, "rate": rate, "scale": scale, "last": first + frames - 1}
    told["data"] = 2 + len(section) // 512
    told |= header or {}
    head = b"\x02\x50" + numbers.words(told["points"], analog, first, told["last"], 0) + numbers.reals(told["scale"])
    head += numbers.words(told["data"], 1 if analog else 0) + numbers.reals(told["rate"])
    path.write_bytes(head.ljust(512, b"\0") + section + _data(positions, scale, analog, numbers))
    return path


def _section(parameters: dict[str, tuple[int, Sequence[int], bytes]], numbers: Numbers) -> bytes:
    groups = list(dict.fromkeys(name.partition(":")[0] for name in parameters))
    entries = [_entry(group, -k, b"\0", numbers) for k, group in enumerate(groups, 1)]
    for name, (kind, sizes, values) in parameters.items():
        group, _, leaf = name.partition(":")
        content = struct.pack("bB", kind, len(sizes)) + bytes(sizes) + values + b"\0"
        entries.append(_entry(leaf, 1 + groups.index(group), content, numbers))
    body = b"".join(entries) + b"\0\0"
    blocks = -(-(len(body) + 4) // 512)
    return (bytes([1, 0x50, blocks, numbers.processor]) + body).ljust(512 * blocks, b"\0")


def _entry(name: str, group: int, content: bytes, numbers: Numbers) -> bytes:
    return struct.pack("bb", len(name), group) + name.encode() + numbers.words(2 + len(content)) + content


def _data(positions: np.ndarray, scale: float, analog: int, numbers: Numbers) -> bytes:
    out = []
    for frame in positions:
        for x in frame:
            lost = bool(np.isnan(x).any())
            if scale < 0:
                out.append(numbers.reals([0, 0, 0, -1] if lost else [*x, 0]))
            else:
                out.append(numbers.words(*([0, 0, 0, -1] if lost else [*np.round(x / scale).astype(int), 0])))
        out.append(numbers.reals(np.full(analog, 7.0)) if scale < 0 else numbers.words(*[7] * analog))
    return b"".join(out)
