"""Judge many scenes or commands in processes of their own, and gather what cqrun takes wrongly."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from gallery import write_gallery

ROOT = Path(__file__).parents[2]

LARGE = ("hexapod", "octopod", "quadruped", "creature", "rhino", "leg_")
"""Beginnings of the names of shipped scenes that take seconds to validate."""

MEGABYTES, SECONDS = 2048, 20.0
"""What a scene may take: memory, and time of a processor."""


def all_scenes(folder: Path) -> list[Path]:
    """Write the gallery to a folder, and the shipped scenes with their files; return the paths, large scenes last."""
    shipped = sorted((ROOT / "scenes").glob("*/*.yaml"))
    copies = [Path(shutil.copy(path, folder)) for path in shipped]
    (folder / "shapes").symlink_to(ROOT / "scenes" / "control" / "shapes")
    return write_gallery(folder) + sorted(copies, key=lambda path: path.name.startswith(LARGE))


def faults(folder: Path, texts: Iterable[tuple[str, str]]) -> list[str]:
    """Return what is wrong with how cqrun takes scenes: a line or a traceback for each, with its name.

    Args:
        folder: where scenes are written, beside the files that they name.
        texts: name and text of each scene; those with faults are left in the folder.
    """
    names = []
    for name, text in texts:
        names.append(f"{name}.yaml")
        (folder / names[-1]).write_bytes(text.encode("utf-8", "surrogatepass"))
    found: list[str] = []
    for name, fault in judged("judge.py", names, folder):
        if fault:
            found.append(f"{name}: {fault}")
        else:
            (folder / name).unlink()
    return found


def judged(script: str, lines: Sequence[str], *words: str | Path) -> Iterator[tuple[str, Any]]:
    """Yield what a script of this folder finds of each line, in a process with limits; text if the process ended there.

    Args:
        script: name of its file; it judges what standard input says, line by line, by `judge.judge_lines`.
        words: its words after the limits.
    """
    command = [sys.executable, "-W", "ignore", str(Path(__file__).with_name(script)), str(MEGABYTES), str(SECONDS)]
    while lines:
        ended = subprocess.run(
            [*command, *map(str, words)], input="\n".join(lines), capture_output=True, text=True, cwd=ROOT
        )
        done = [json.loads(line) for line in ended.stdout.splitlines()]
        yield from map(tuple, done)
        lines = lines[len(done) :]
        if lines:
            yield lines[0], f"the process ended: {ended.returncode}\n{ended.stderr[-4000:]}"
            lines = lines[1:]
