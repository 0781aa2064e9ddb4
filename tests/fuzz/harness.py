"""Judge many scenes in processes of their own, and gather those that cqrun takes wrongly."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

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
    while names:
        done, ended = _judge(folder, names)
        for name, fault in done:
            if fault:
                found.append(f"{name}: {fault}")
            else:
                (folder / name).unlink()
        names = names[len(done) :]
        if names:
            found.append(f"{names.pop(0)}: the process ended: {ended}")
    return found


def _judge(folder: Path, names: list[str]) -> tuple[list[tuple[str, str]], str]:
    """Return the judged scenes with what is wrong, and how the process ended if it did not judge all of them."""
    words = [sys.executable, "-W", "ignore", str(Path(__file__).with_name("judge.py"))]
    words += [str(folder), str(MEGABYTES), str(SECONDS)]
    ended = subprocess.run(words, input="\n".join(names), capture_output=True, text=True, cwd=ROOT)
    return [json.loads(line) for line in ended.stdout.splitlines()], f"{ended.returncode}\n{ended.stderr[-4000:]}"
