"""Base of shapes that are read from a file: its path, its version, and its check before anything else runs."""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path

from pydantic import Field

from cqrun.errors import UsageError
from cqrun.geometry.shape import Shape
from cqrun.memory import shortage
from cqrun.plugin.reference import FileName, why_unreadable

Stamp = tuple[Path, int, int]
"""What identifies a version of a file: path, time and size."""


class FileShape(Shape):
    """A shape in a file; the file's content is part of the run's identity."""

    file: FileName = Field(description="File, from the scene's folder", min_length=1)

    @property
    def path(self) -> Path:
        """Where the file is."""
        return self.path_of(self.file)

    def stamp(self) -> Stamp:
        """Return what identifies this version of the file: path, time and size.

        Raises:
            UsageError: there is no such file, or none that can be read.
        """
        return stamp_of(self.path)

    @abstractmethod
    def examine(self) -> list[str]:
        """Read the file and return warnings about it.

        Raises:
            UsageError: it is missing or unreadable, or no body can be made from it.
        """


def stamp_of(path: Path) -> Stamp:
    """Return what identifies this version of a file.

    Raises:
        UsageError: there is no such file, or none that can be read.
    """
    if why := why_unreadable(path):
        raise UsageError(f"{path}: cannot be read ({why}); the name starts from the scene's folder")
    stat = path.stat()
    return path, stat.st_mtime_ns, stat.st_size


def require_memory(path: Path, need: int, advice: str) -> None:
    """Raise a UsageError if reading a file needs more memory [bytes] than is free."""
    if lack := shortage("reading it needs about", need, advice):
        raise UsageError(f"{path}: {lack}")
