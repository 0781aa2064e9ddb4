"""Damage a file of a run as disks, copies and people do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

HOW = ("missing", "empty", "cut", "bit", "bytes", "zeros", "doubled", "another", "number", "folder")


def damage(run: Path, rng: np.random.Generator) -> tuple[Path, str]:
    """Damage a file of a run, except its lock; return the file and how."""
    files = sorted(path for path in run.rglob("*") if path.is_file() and path.name != "lock")
    path, how = _pick(files, rng), str(_pick(HOW, rng))
    content, another = path.read_bytes(), _pick(files, rng).read_bytes()
    path.unlink()
    if how == "folder":
        path.mkdir()
    elif how == "another":
        path.write_bytes(another)
    elif how != "missing":
        path.write_bytes(_damaged(content, how, rng))
    return path, how


def _damaged(content: bytes, how: str, rng: np.random.Generator) -> bytes:
    if how == "empty" or not content:
        return b""
    first = int(rng.integers(len(content)))
    last = min(len(content), first + int(rng.integers(1, 65)))
    match how:
        case "cut":
            return content[:first]
        case "bit":
            return content[:first] + bytes([content[first] ^ (1 << int(rng.integers(8)))]) + content[first + 1 :]
        case "bytes":
            return content[:first] + rng.bytes(last - first) + content[last:]
        case "zeros":  # as after a power cut: the length is there, the blocks are not
            return content[:first] + bytes(len(content) - first)
        case "number":  # a digit of a text, or a byte that looks like one
            digits = [k for k, byte in enumerate(content) if byte in b"0123456789"]
            at = _pick(digits, rng) if digits else first
            return content[:at] + b"%d" % rng.integers(10) + content[at + 1 :]
        case _:
            return content + content


def _pick(choices: Any, rng: np.random.Generator) -> Any:
    return choices[int(rng.integers(len(choices)))]
