"""Where each value of a scene came from: a place in a file, or an override."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import ValidationError

from cqrun.errors import Problem
from cqrun.explain import KEY, MISSING, VALUE, Loc
from cqrun.scene.document import Document
from cqrun.scene.keypath import joined, locate


@dataclass(frozen=True)
class Override:
    """One `-o key=value`, as typed."""

    text: str
    path: str

    @property
    def where(self) -> str:
        """How messages name it."""
        return f"-o {self.text}"

    def covers(self, path: str) -> bool:
        """Say whether it set the path or something around it."""
        return path == self.path or path.startswith(f"{self.path}.")


@dataclass(frozen=True)
class Origin:
    """A scene's text, its file and what was overridden."""

    document: Document = field(default_factory=lambda: Document({}))
    overrides: tuple[Override, ...] = ()
    source: Path | None = None
    text: str = ""

    def where_path(self, path: str) -> str:
        """Return where a key path was set."""
        return self._where(locate(self.document.data, path))

    def problems(self, error: ValidationError) -> list[Problem]:
        """Return a validation's findings with their places: the file's by line, then the overrides'."""
        found: list[tuple[tuple[int, int, int], Problem]] = []
        for details in error.errors(include_url=False):
            loc, kind = details["loc"], details["type"]
            assert kind in (KEY, MISSING, VALUE), details
            context = details["ctx"]
            causes = [place for name in context["involves"] for place in ((*loc[:-1], name), (*loc, name))]
            where = self._where(loc, causes, at_key=kind == KEY)
            by_override = where.startswith("-o ")
            line, column = (0, 0) if by_override else self.document.position(loc, at_key=kind == KEY)
            found.append(((by_override, line, column), Problem(where, joined(loc), context["message"])))
        return [problem for _, problem in sorted(found, key=lambda item: item[0])]

    def _where(self, loc: Loc, causes: Iterable[Loc] = (), *, at_key: bool = False) -> str:
        """Return the override that set a place or one of its other possible causes, else the file's place."""
        for override in reversed(self.overrides):
            for place in (loc, *causes):
                made_on_the_way = override.path.startswith(f"{joined(place)}.")
                if override.covers(joined(place)) or made_on_the_way and not self.document.leads_on(place):
                    return override.where
        return self.document.where(loc, at_key=at_key)
