"""Load a scene from a file, text or data; all problems are reported at once, each with its place."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from cqrun.errors import Problem, SceneError
from cqrun.explain import complaint
from cqrun.scene.defaults import with_vector
from cqrun.scene.document import Document, read, text_of, with_number, write
from cqrun.scene.fragments import with_fragments
from cqrun.scene.keypath import is_named, locate, removed, replaced
from cqrun.scene.origin import Origin, Override
from cqrun.scene.paths import plain
from cqrun.scene.plugin_files import findings_of_plugins
from cqrun.scene.schema import Scene
from cqrun.scene.unknowns import findings_of_paths


def load_scene(source: Path | str | dict[str, Any], overrides: Sequence[str] = (), base: Path | None = None) -> Scene:
    """Return a validated scene.

    Args:
        source: a file's path, YAML text (a str with a line break), or plain data.
        overrides: texts `key.path=value`, with the value in YAML; a later one overrides an earlier one, and null
            removes a named part or a section.
        base: folder of the files that the scene names, for a scene in a run directory; its plug-ins are in `plugins/`
            beside the scene. If None, files and plug-ins are in the folder of the scene's file.

    Plug-in files that the scene names are run, but only inside `plugins_allowed()` (scene/plugin_files.py).

    Raises:
        SceneError: with every problem: `file:line:column: key.path: what is wrong`, sorted by line, then
            `-o key=value: key.path: what is wrong`.
    """
    document, path, text = _document(source)
    data, applied = _overridden(document.data, overrides)
    origin = Origin(document, tuple(applied), path, text, base)
    try:
        data = with_fragments(data, origin.path_of)
        if findings := findings_of_plugins(data, origin):
            raise complaint("Scene", findings)
        scene = _validated(data, path is None and not text)
        if findings := findings_of_paths(scene):
            raise complaint("Scene", findings)
    except ValidationError as error:
        raise SceneError(origin.problems(error)) from None
    scene.set_origin(origin)
    return scene


def _validated(data: dict[str, Any], is_data: bool) -> Scene:
    """Return the scene of plain data; where a number is missing and data have a text such as `1.0e4`, it is one."""
    while True:
        try:
            return Scene.model_validate(data)
        except ValidationError as error:
            replaced = [with_number(data, found["loc"]) for found in error.errors(include_url=False)] if is_data else []
            if not any(replaced):
                raise


def resolve(scene: Scene) -> dict[str, Any]:
    """Return plain data with every default; values that are None are omitted."""
    data: dict[str, Any] = plain(scene.model_dump(exclude_none=True))
    return data


def dump(data: dict[str, Any]) -> str:
    """Return YAML text of plain data; it loads as bit-for-bit identical data."""
    return write(data)


def _document(source: Path | str | dict[str, Any]) -> tuple[Document, Path | None, str]:
    """Return the document, its file if it has one, and its text."""
    if isinstance(source, dict):
        return Document(plain(source)), None, ""
    if isinstance(source, str) and "\n" in source:
        return read(source), None, source
    path = Path(source)
    try:
        text = text_of(path)
    except OSError as error:
        raise SceneError([Problem(str(path), "", f"the scene cannot be read: {_why_unread(path, error)}")]) from None
    return read(text, str(path)), path, text


def _why_unread(path: Path, error: OSError) -> str:
    """Return why a file cannot be read and, for a directory, what would be right."""
    if not isinstance(error, IsADirectoryError):
        return error.strerror or str(error)
    if not (path / "run.json").is_file():
        return "it is a directory; a scene is a YAML file"
    return (
        "it is the directory of a run; give the file of the scene that was run, or use `cqrun resume RUN` to continue "
        "the run, or `cqrun simulate RUN` to replay it"
    )


def _overridden(data: Any, overrides: Sequence[str]) -> tuple[Any, list[Override]]:
    """Return data with the overrides merged in, and the overrides that were applied."""
    applied: list[Override] = []
    problems: list[Problem] = []
    for text in overrides:
        path, equals, value = text.partition("=")
        path = path.strip()
        where = Override(text, path).where
        if not (equals and path and value.strip()):
            problems.append(Problem(where, path, "must be key.path=value"))
            continue
        try:
            data = with_vector(data, path)
            loc, new = locate(data, path), read(value).data
            is_part = is_named(loc) or (len(loc) == 1 and loc[0] in data)  # or a section of the scene
            data = removed(data, loc) if new is None and is_part else replaced(data, loc, new)
        except SceneError as error:
            problems += [Problem(where, p.path or path, p.message) for p in error.problems]
        except KeyError as error:
            problems.append(Problem(where, path, str(error.args[0])))
        applied.append(Override(text, path))
    if problems:
        raise SceneError(problems)
    return data, applied
