"""The folder of a run: which names in it are cqrun's. No link is followed there, and nothing else is deleted.

The name of a run follows from its scene, so a folder of results from a stranger may hold, under the name of a run or of
a file in one, a link to files of the user's own. Such a folder is refused before anything in it is read or written.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Collection, Iterator
from fnmatch import fnmatchcase
from pathlib import Path

from cqrun.disk import require_ordinary
from cqrun.errors import UsageError
from cqrun.explain import listed
from cqrun.scene.origin import PLUGINS
from cqrun.store.atomic import disk_errors, make_directory

RECORD, LOCK, REPORT = "run.json", "lock", "report.html"
FIGURES, DESIGN, SYNTHETIC, POINTS = "figures", "design", "synthetic", "points"
TEMPORARY = ".*.[0-9]*.tmp"

OWN_FILES = (
    RECORD, LOCK, "scene.yaml", "scene.original.yaml", "log.txt", "history.csv", "evals.log", "evals.[01].npz",
    "result.json", "gradcheck.json", "identified.json", "controller.npz", "activation.csv", "observables.csv",
    REPORT, "measurements.csv", "reactions.csv", "rest.csv", "tracks.csv", "trajectory.h5", "trajectory.h5.part",
    "trajectory.h5.new", "trajectory.h5.packing", "trajectory.vtkhdf",
)  # fmt: skip
"""Patterns of the files of a run; tables of other measurements have names of their own (`RunScene.tables`)."""

OWN_FOLDERS = {
    FIGURES: tuple(
        f"{picture}.{kind}"
        for picture in (
            "convergence", "tracks_*", "bodies", "path", "measured", "reactions", "design", "shape", "overview",
            "compare_*", "motion_*", "last_*", "still_*", "onion_*",
        )
        for kind in ("png", "pdf", "gif", "mp4")
    ),
    PLUGINS: ("*.py",),
    DESIGN: ("design.csv", "design.vtkhdf", "surface_*.stl", "outline_*.csv"),
    SYNTHETIC: ("*.csv", "*.part"),
    POINTS: ("*.npz",),
}  # fmt: skip
"""Folders inside a run, and patterns of the files in each."""

MOST_NAMES = 5
"""Largest number of foreign names in a message."""


def make_below(folder: Path, *names: str) -> Path:
    """Make folders inside one that the user has named, unless they exist; return the last one.

    Raises:
        UsageError: one of them is a link or a file, or cannot be made. RunError: the disk is full.
    """
    make_directory(folder)
    for name in names:
        if name in ("", ".", ".."):
            raise UsageError(f"{folder}: no folder inside it can be named '{name}'; give the scene's file another name")
        folder = folder / name
        with disk_errors(folder):
            require_ordinary(folder, folder=True)
            folder.mkdir(exist_ok=True)
    return folder


def require_own(run: Path) -> None:
    """Refuse a run that is a link, or in which a name of cqrun's is a link or another kind of thing.

    Raises:
        UsageError: it is so.
    """
    with disk_errors(run):
        if run.is_symlink():
            raise UsageError(
                f"{run}: is a link to {run.readlink()}, and cqrun follows no links in its results; give that folder"
            )
        for name in _names(run):
            if name in OWN_FOLDERS:
                require_ordinary(run / name, folder=True)
                for inside in _names(run / name):
                    require_ordinary(run / name / inside)
            elif _is_own(name, OWN_FILES) or name.endswith(".csv"):
                require_ordinary(run / name)


def clear(run: Path, tables: Collection[str] = ()) -> None:
    """Delete the files of a run, except its lock; run.json first, because without it the rest is ignored.

    Hidden files of other programs stay.

    Args:
        tables: names of its tables of measurements.

    Raises:
        UsageError: it holds a link, or something that cqrun did not write; then nothing is deleted.
    """
    require_own(run)
    own = (*OWN_FILES, *tables)
    foreign = [name for name in _names(run) if name not in OWN_FOLDERS and not _is_own(name, own)]
    for folder, patterns in _folders(run):
        foreign += [f"{folder}/{name}" for name in _names(run / folder) if not _is_own(name, patterns)]
    if foreign := [name for name in foreign if not Path(name).name.startswith(".")]:
        raise UsageError(
            f"{run}: holds {listed(foreign, MOST_NAMES)}, which cqrun did not write; nothing was deleted: move it "
            "elsewhere, or choose another place with --out"
        )
    with disk_errors(run):
        (run / RECORD).unlink(missing_ok=True)
        for folder, patterns in _folders(run):
            _delete(run / folder, patterns)
            _remove_if_empty(run / folder)
        _delete(run, own)


def remove_temporary_files(run: Path) -> None:
    """Delete what a killed process was writing; this process has the lock."""
    with disk_errors(run):
        for folder in (run, *(run / name for name, _ in _folders(run))):
            _delete(folder, ())


def _names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []


def _folders(run: Path) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield the folders that a run has, and the patterns of their files."""
    yield from ((name, patterns) for name, patterns in OWN_FOLDERS.items() if (run / name).is_dir())


def _is_own(name: str, patterns: Collection[str]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in (*patterns, TEMPORARY))


def _delete(folder: Path, patterns: Collection[str]) -> None:
    """Delete the files of a folder that match patterns, and the temporary ones, but no lock.

    They are deleted through the open folder, which cannot be exchanged for a link meanwhile.
    """
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        for name in os.listdir(handle):  # noqa: PTH208  of the open folder
            if _is_own(name, patterns) and name != LOCK:
                os.unlink(name, dir_fd=handle)
    finally:
        os.close(handle)


def _remove_if_empty(folder: Path) -> None:
    try:
        folder.rmdir()
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
            raise
