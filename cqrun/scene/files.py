"""Find the files that a scene names, and those of them that cannot be read."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from cqrun.errors import Problem
from cqrun.explain import Loc
from cqrun.plugin.reference import NamesFile, why_unreadable
from cqrun.scene.keypath import joined
from cqrun.scene.schema import Scene
from cqrun.scene.sections import Sections
from cqrun.scene.walk import marked

DATA = "data"
"""The section whose files are read only by jobs that fit something."""

READ_BY_EVERY_JOB = tuple(name for name in Sections.model_fields if name != DATA)
"""The sections whose files every run depends on."""


def named_files(scene: Scene) -> Iterator[tuple[Loc, str]]:
    """Yield (place, name) for every file name in a scene, except plug-in files."""
    for found in marked(scene, NamesFile):
        yield found.loc, found.value


def files_by_name(scene: Scene, *, of_data: bool) -> dict[str, Path]:
    """Return the paths of the data files of a scene, or of all other files, by the names that the scene uses."""
    return {name: scene.resolve_path(name) for loc, name in named_files(scene) if (loc[0] == DATA) == of_data}


def unreadable_files(scene: Scene, sections: Iterable[str]) -> list[Problem]:
    """Return a problem for every unreadable file that the given sections of a scene name."""
    wanted, problems = set(sections), []
    for loc, name in named_files(scene):
        if loc[0] in wanted and (why := why_unreadable(scene.resolve_path(name))):
            message = f"{scene.resolve_path(name)}: cannot be read ({why}); the name starts from the scene's folder"
            problems.append(Problem(scene.where(joined(loc)), joined(loc), message))
    return problems
