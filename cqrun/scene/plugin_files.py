"""A user's own plug-ins: Python files that a scene names. They are run only if that is allowed.

    plugins: [my_law.py]

The name of a file's module contains a hash of its content. So a changed file is another module, which shares no
compiled code with the old one, and the copy in a run directory is the same module as the original file.
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

DIFFERENTIABLE: dict[str, Callable[[type[Any]], Sequence[str]]] = {
    "elastic": lambda cls: getattr(cls, "parameters", ()),
    "material_term": lambda cls: getattr(cls, "parameters", ()),
    "actuator": lambda cls: (cls.scale, "weight"),
    "boundary": lambda cls: ("coefficient",),
}
"""For kernel plug-ins by kind, the fields that the engine's adjoint reaches (for a load, those of its `apply_vjp`)."""

_ALLOWED: ContextVar[bool] = ContextVar("plugins_allowed", default=False)
_LOADED: dict[str, list[type[Any]]] = {}
"""The plug-ins of every file that this process has loaded, by module."""


@contextmanager
def plugins_allowed(allowed: bool = True) -> Iterator[None]:
    """Allow or forbid that scenes loaded inside this context run the Python files that they name."""
    before = _ALLOWED.set(allowed)
    try:
        yield
    finally:
        _ALLOWED.reset(before)


def findings_of_plugins(data: Any, origin: Origin) -> list[InitErrorDetails]:
    """Load the plug-in files of a scene, and return what is wrong with them.

    Args:
        data: the scene's plain data; the schema reports `plugins` that are not a list of names.
        origin: where the scene comes from.
    """
    names = data.get("plugins") if isinstance(data, dict) else None
    if not names or not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        return []
    if not _ALLOWED.get():
        message = (
            f"this scene wants to run Python files of its own: {listed(names)}; such a file can do whatever you can, "
            "even delete your files or send them to others. Read it first; if you trust it, allow it with "
            "--allow-plugins (in Python: allow_plugins=True)"
        )
        return [finding(message, ("plugins",), kind=KEY)]
    problems: list[tuple[int, str]] = []
    paths = origin.plugin_paths(names)
    for i, (name, path) in enumerate(zip(names, paths, strict=True)):
        if path.name in [other.name for other in paths[:i]]:
            problems.append((i, f"two files are called '{path.name}'; a run keeps them in one folder: rename one"))
        elif not path.is_file():
            problems.append((i, f"there is no file '{path}'; a name is relative to the scene's folder"))
        elif path.suffix != ".py":
            problems.append((i, f"'{name}' is not a Python file: its name must end in .py"))
    return [finding(message, ("plugins", i)) for i, message in problems or _load_all(paths)]


def load_plugin_files(paths: Sequence[Path]) -> None:
    """Load plug-in files that the user has named explicitly.

    Raises:
        UsageError: a file cannot be used.
    """
    for _, message in _load_all(paths):
        raise UsageError(message)


def _load_all(paths: Sequence[Path]) -> list[tuple[int, str]]:
    """Load plug-in files; return what is wrong as (index of the file, message)."""
    for folder in dict.fromkeys(registry.FOLDERS.values()):  # built-in plug-ins first, so that their names are known
        registry.plugins(next(kind for kind, place in registry.FOLDERS.items() if place == folder))
    problems, earlier = [], set(_LOADED)
    for i, path in enumerate(paths):
        try:
            content = path.read_bytes()
            module = _module_name(path, content)
            earlier.discard(module)
            with registry.changes(replaceable=earlier):
                _load(module, path, content)
        except OSError as error:
            problems.append((i, f"{path}: cannot be read ({error.strerror})"))
        except UsageError as error:
            problems.append((i, str(error)))
    return problems


def _module_name(path: Path, content: bytes) -> str:
    return f"cqrun_plugin_{re.sub(r'[^a-zA-Z0-9_]', '_', path.stem)}_{hashlib.sha256(content).hexdigest()[:12]}"


def _load(module: str, path: Path, content: bytes) -> None:
    """Run a file, or register its plug-ins again if it was run before.

    Raises:
        UsageError: the file raises an error, or registers no plug-in that can be used.
    """
    try:
        if module not in _LOADED:
            _run(module, path, content)
        for cls in _LOADED.get(module, ()):  # a file of another scene may have taken their names since
            registry.plugin(cls.kind, cls.name)(cls)
    except (Exception, SystemExit) as error:
        raise UsageError(_error_text(path, error)) from error
    classes = registry.of_module(module)
    _require_usable(path, classes)
    if module not in _LOADED and has_kernels(content):
        add_kernels(module)
    _LOADED[module] = classes


def _run(module: str, path: Path, content: bytes) -> None:
    """Run a file's content as a module, without Python's cache, which compares only the file's time and size."""
    instance = ModuleType(module)
    instance.__file__ = str(path)
    sys.modules[module] = instance
    exec(compile(content, str(path), "exec", dont_inherit=True), vars(instance))


def _require_usable(path: Path, classes: Sequence[type[Any]]) -> None:
    if not classes:
        raise UsageError(
            f"{path} registers no plug-in: decorate a class with @plugin(kind, name) of cqrun.plugin.registry"
        )
    for cls in classes:
        if not issubclass(cls, Plugin):
            raise UsageError(
                f"{path}: class {cls.__name__} is registered as {cls.kind} '{cls.name}' and must derive from the same "
                f"base class as the others in {registry.FOLDERS[cls.kind]}"
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
        reached = DIFFERENTIABLE[cls.kind](cls) if cls.kind in DIFFERENTIABLE else cls.model_fields
        if lost := [name for name in cls.model_fields if is_differentiable(cls, name) and name not in reached]:
            raise UsageError(
                f"{path}: class {cls.__name__}, {cls.kind} '{cls.name}', declares {listed(lost)} differentiable, which "
                f"no gradient reaches: for this kind gradients reach {listed(reached)}"
            )


def _error_text(path: Path, error: BaseException) -> str:
    """Return which error a file raised, and in which of its lines."""
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    what = str(error)
    if isinstance(error, SyntaxError) and error.filename == str(path):
        lines, what = [error.lineno], error.msg
    number = next((line for line in reversed(lines) if line), 1)
    linecache.checkcache(str(path))
    source = linecache.getline(str(path), number).strip()
    return f"{path}:{number}: raises {type(error).__name__}: {what}" + (f"; in the line: {source}" if source else "")
