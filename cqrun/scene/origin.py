"""Where each value of a scene comes from: a place in a file, or an override."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import ValidationError

from cqrun.errors import Problem
from cqrun.explain import KEY, Loc, cut
from cqrun.plugin.contract import from_folder
from cqrun.scene.document import Document
from cqrun.scene.keypath import joined, locate

PLUGINS = "plugins"
"""Folder of a run with copies of its plug-in files."""

_AFTER_THE_FILE = 10**9
"""A line number larger than any in a file."""


@dataclass(frozen=True)
class Override:
    """One `-o key=value` as typed."""

    text: str
    path: str

    @property
    def where(self) -> str:
        """Its name in messages; a long value is cut, because it would hide the message."""
        path, equals, value = self.text.partition("=")
        return f"-o {path}{equals}{cut(value)}"

    def covers(self, path: str) -> bool:
        """Return whether it set the path or a part that contains it."""
        return path == self.path or path.startswith(f"{self.path}.")


@dataclass(frozen=True)
class Origin:
    """The text of a scene, its file and its overrides; `base` is the folder of the files that it names."""

    document: Document = field(default_factory=lambda: Document({}))
    overrides: tuple[Override, ...] = ()
    source: Path | None = None
    text: str = ""
    base: Path | None = None

    def where_path(self, path: str) -> str:
        """Return the place where a key path was set."""
        loc = locate(self.document.data, path)
        override = self._cause([loc])
        return override.where if override is not None else self.document.where(loc)

    def path_of(self, file: str) -> Path:
        """Return the path of a file that the scene names; `~` is the user's home."""
        return from_folder(self.base or (self.source.parent if self.source else Path()), file)

    def plugin_paths(self, names: Iterable[str]) -> list[Path]:
        """Return the paths of plug-in files: the copies in a run directory, or the files that the scene names."""
        if self.base is not None and self.source is not None:
            return [self.source.parent / PLUGINS / Path(name).name for name in names]
        return [self.path_of(name) for name in names]

    def problems(self, error: ValidationError) -> list[Problem]:
        """Return a validation's findings with their places: those in the file by line, then those of overrides."""
        problems: list[tuple[tuple[int, int], Problem]] = []
        for details in error.errors(include_url=False):
            loc, at_key = details["loc"], details["type"] == KEY
            context = details["ctx"]
            causes = [place for name in context["involves"] for place in ((*loc[:-1], name), (*loc, name))]
            override = self._cause((loc, *causes))
            if override is None:
                order, where = (
                    self.document.position(loc, at_key=at_key),
                    self.document.where(loc, at_key=at_key),
                )
            else:
                order, where = (_AFTER_THE_FILE, self.overrides.index(override)), override.where
            problems.append((order, Problem(where, joined(loc), context["message"])))
        return [problem for _, problem in sorted(problems, key=lambda item: item[0])]

    def _cause(self, places: Iterable[Loc]) -> Override | None:
        """Return the last override that set one of the places, or that created a mapping there on its way."""
        for override in reversed(self.overrides):
            for place in places:
                passes = override.path.startswith(f"{joined(place)}.")
                if override.covers(joined(place)) or (passes and not self.document.has_part_at(place)):
                    return override
        return None
