"""Plug-ins of a user's own: Python files that a scene names, run only where that is allowed.

    plugins: [my_law.py]

A file is a module named after its content: one that was changed is another module, which shares no compiled code with
what it was, and the copy that a run keeps is the same module as the file it was copied from.
"""

from __future__ import annotations

import hashlib
import inspect
import linecache
import re
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from types import ModuleType
from typing import Any

from pydantic_core import InitErrorDetails

from cqrun.errors import UsageError
from cqrun.explain import KEY, finding, listed
from cqrun.fingerprint import add_kernels, has_kernels
from cqrun.plugin import registry
from cqrun.plugin.contract import Plugin, is_differentiable
from cqrun.plugin.reference import NamesBody, NamesGroup, marked_fields, marks
from cqrun.scene.origin import Origin

REACHED: dict[str, Callable[[type[Any]], Sequence[str]]] = {
    "elastic": lambda cls: getattr(cls, "parameters", ()),
    "material_term": lambda cls: getattr(cls, "parameters", ()),
    "actuator": lambda cls: (cls.scale, "weight"),
    "boundary": lambda cls: ("coefficient",),
}
"""Of plug-ins that are kernels, the fields that the engine's adjoint reaches; of a load those of its `apply_vjp`."""

_ALLOWED: ContextVar[bool] = ContextVar("plugins_allowed", default=False)
_TAKEN: dict[str, list[type[Any]]] = {}
"""The plug-ins of every file that this process has run, by module."""


@contextmanager
def plugins_allowed(allowed: bool = True) -> Iterator[None]:
    """Let scenes that are loaded meanwhile run the Python files that they name, or not."""
    before = _ALLOWED.set(allowed)
    try:
        yield
    finally:
        _ALLOWED.reset(before)


def findings_of_plugins(data: Any, origin: Origin) -> list[InitErrorDetails]:
    """Make the plug-ins of a scene's files known, and return what is wrong with them.

    Args:
        data: the scene's plain data; what is no list of names is left to the schema.
        origin: where it came from.
    """
    names = data.get("plugins") if isinstance(data, dict) else None
    if not names or not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        return []
    if not _ALLOWED.get():
        message = (
            f"this scene wants to run Python files of its own: {listed(names)}; such a file can do whatever you can, "
            "also delete your files or send them away. Read it first; if you trust it, allow it by --allow-plugins "
            "(in Python: allow_plugins=True)"
        )
        return [finding(message, ("plugins",), kind=KEY)]
    found: list[tuple[int, str]] = []
    paths = origin.plugin_paths(names)
    for i, (name, path) in enumerate(zip(names, paths, strict=True)):
        if path.name in [other.name for other in paths[:i]]:
            found.append((i, f"two files are called '{path.name}'; a run keeps them side by side: rename one"))
        elif not path.is_file():
            found.append((i, f"there is no file '{path}'; a name is relative to the scene's folder"))
        elif path.suffix != ".py":
            found.append((i, f"'{name}' is no Python file: its name must end in .py"))
    return [finding(message, ("plugins", i)) for i, message in found or _take_all(paths)]


def take_files(paths: Sequence[Path]) -> None:
    """Make the plug-ins of files known that somebody has named on purpose.

    Raises:
        UsageError: one that cannot be used.
    """
    for _, message in _take_all(paths):
        raise UsageError(message)


def _take_all(paths: Sequence[Path]) -> list[tuple[int, str]]:
    """Make the plug-ins of files known; return what is wrong, with the file's place in the list."""
    for folder in dict.fromkeys(registry.FOLDERS.values()):  # first, so that a name they have is taken
        registry.plugins(next(kind for kind, place in registry.FOLDERS.items() if place == folder))
    found, earlier = [], set(_TAKEN)
    for i, path in enumerate(paths):
        try:
            content = path.read_bytes()
            module = _module_name(path, content)
            earlier.discard(module)
            with registry.changes(giving_way=earlier):
                _take(module, path, content)
        except OSError as error:
            found.append((i, f"{path}: cannot be read ({error.strerror})"))
        except UsageError as error:
            found.append((i, str(error)))
    return found


def _module_name(path: Path, content: bytes) -> str:
    return f"cqrun_plugin_{re.sub(r'[^a-zA-Z0-9_]', '_', path.stem)}_{hashlib.sha256(content).hexdigest()[:12]}"


def _take(module: str, path: Path, content: bytes) -> None:
    """Run a file, or recall what it registered when it was run before.

    Raises:
        UsageError: it raises an error, or registers nothing that could be used.
    """
    try:
        if module not in _TAKEN:
            _run(module, path, content)
        for cls in _TAKEN.get(module, ()):  # names that another scene's file has taken meanwhile
            registry.plugin(cls.kind, cls.name)(cls)
    except (Exception, SystemExit) as error:
        raise UsageError(_told(path, error)) from error
    classes = registry.of_module(module)
    _require_usable(path, classes)
    if module not in _TAKEN and has_kernels(content):
        add_kernels(module)
    _TAKEN[module] = classes


def _run(module: str, path: Path, content: bytes) -> None:
    """Run a file's content as a module; past Python's own cache, which goes by the file's time and size."""
    made = ModuleType(module)
    made.__file__ = str(path)
    sys.modules[module] = made
    exec(compile(content, str(path), "exec", dont_inherit=True), vars(made))


def _require_usable(path: Path, classes: Sequence[type[Any]]) -> None:
    if not classes:
        raise UsageError(
            f"{path} registers no plug-in: decorate a class with @plugin(kind, name) of cqrun.plugin.registry"
        )
    for cls in classes:
        if not issubclass(cls, Plugin):
            raise UsageError(
                f"{path}: class {cls.__name__} is registered as {cls.kind} '{cls.name}' and must derive from what "
                f"others in {registry.FOLDERS[cls.kind]} derive from"
            )
        if inspect.isabstract(cls):
            missing = listed(sorted(cls.__abstractmethods__))
            raise UsageError(f"{path}: class {cls.__name__}, {cls.kind} '{cls.name}', lacks methods: {missing}")
        bodies = marked_fields(cls, NamesBody)
        for mark in (mark for info in cls.model_fields.values() for mark in marks(info, NamesGroup)):
            if mark.of not in (None, *bodies):
                raise UsageError(
                    f"{path}: class {cls.__name__}, {cls.kind} '{cls.name}', has a group of the body that '{mark.of}' "
                    f"names, and no such field of the type BodyName; fields of it: {listed(bodies)}"
                )
        reached = REACHED[cls.kind](cls) if cls.kind in REACHED else cls.model_fields
        if lost := [name for name in cls.model_fields if is_differentiable(cls, name) and name not in reached]:
            raise UsageError(
                f"{path}: class {cls.__name__}, {cls.kind} '{cls.name}', declares {listed(lost)} differentiable, which "
                f"no gradient reaches: of this kind it reaches {listed(reached)}"
            )


def _told(path: Path, error: BaseException) -> str:
    """Say what a file raised, and in which of its lines."""
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    what = str(error)
    if isinstance(error, SyntaxError) and error.filename == str(path):
        lines, what = [error.lineno], error.msg
    number = next((line for line in reversed(lines) if line), 1)
    linecache.checkcache(str(path))
    source = linecache.getline(str(path), number).strip()
    return f"{path}:{number}: raises {type(error).__name__}: {what}" + (f"; in the line: {source}" if source else "")
