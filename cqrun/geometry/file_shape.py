"""What shapes that are read from a file share: where it is, and that a broken one is told before anything else."""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path

from pydantic import Field

from cqrun.errors import UsageError
from cqrun.geometry.shape import Shape
from cqrun.plugin.reference import FileName


class FileShape(Shape):
    """A shape in a file; what it holds is part of the run's name."""

    file: FileName = Field(description="File, from the scene's folder", min_length=1)

    @property
    def path(self) -> Path:
        """Where the file is."""
        return self.path_of(self.file)

    def stamp(self) -> tuple[Path, int, int]:
        """Return what tells this version of the file from others: path, time and size.

        Raises:
            UsageError: there is no such file.
        """
        try:
            about = self.path.stat()
        except OSError as error:
            message = f"{self.path}: cannot be read ({error.strerror}); the name starts from the scene's folder"
            raise UsageError(message) from None
        return self.path, about.st_mtime_ns, about.st_size

    @abstractmethod
    def examine(self) -> list[str]:
        """Read the file and return warnings on it.

        Raises:
            UsageError: it is missing, unreadable, or no body can be made of it.
        """
