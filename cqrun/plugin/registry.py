"""Plug-ins by kind and name: one file in one folder, found by importing that folder.

A plug-in file registers its class with `@plugin(kind, name)`. Nothing else has to change: `cqrun describe`, the scene
schema and the generated tests find it in the registry.
"""

from __future__ import annotations

import importlib
import pkgutil
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any, TypeVar

FOLDERS = {
    "shape": "cqrun.geometry",
    "region": "cqrun.geometry",
    "sampling": "cqrun.geometry",
    "elastic": "cqrun.materials",
    "material_term": "cqrun.materials",
    "actuator": "cqrun.actuators",
    "boundary": "cqrun.boundaries",
    "load": "cqrun.loads",
    "force": "cqrun.forces",
    "controller": "cqrun.controllers",
    "observer": "cqrun.observers",
    "objective": "cqrun.objectives",
    "measure": "cqrun.measures",
    "measurement": "cqrun.measurements",
    "optimizer": "cqrun.optimizers",
}
"""Package with the plug-ins of each kind."""

INCLUDED = {"region": "shape"}
"""Kinds that include the plug-ins of another kind: every shape is also a region, unless a region has its name."""

_PLUGINS: dict[str, dict[str, type[Any]]] = {}
_REPLACEABLE: set[str] = set()

T = TypeVar("T", bound=type[Any])


def plugin(kind: str, name: str) -> Callable[[T], T]:
    """Register a class as the plug-in `name` of `kind` (class decorator)."""
    if kind not in FOLDERS:
        raise ValueError(f"unknown kind of plug-in '{kind}'; kinds are {', '.join(FOLDERS)}")

    def register(cls: T) -> T:
        known = _PLUGINS.setdefault(kind, {})
        other = known.setdefault(name, cls)
        if _identity(other) != _identity(cls) and other.__module__ not in _REPLACEABLE:
            raise ValueError(f"two plug-ins of kind '{kind}' are called '{name}'; the other is in {_place(other)}")
        known[name] = cls
        cls.kind, cls.name = kind, name
        return cls

    return register


def _identity(cls: type) -> tuple[str, str]:
    return cls.__module__, cls.__qualname__


def _place(cls: type) -> str:
    return str(getattr(sys.modules.get(cls.__module__), "__file__", cls.__module__))


@contextmanager
def changes(replaceable: Iterable[str] = ()) -> Iterator[None]:
    """Register all plug-ins inside this context, or none of them if it ends with an error.

    Args:
        replaceable: modules whose plug-ins may be replaced by others of the same name: files of earlier scenes, also
            the same file before it was changed.
    """
    before = {kind: dict(known) for kind, known in _PLUGINS.items()}
    _REPLACEABLE.update(replaceable)
    try:
        yield
    except BaseException:
        _PLUGINS.clear()
        _PLUGINS.update(before)
        raise
    finally:
        _REPLACEABLE.clear()


def of_module(module: str) -> list[type[Any]]:
    """Return the plug-ins that a module has registered."""
    return [cls for known in _PLUGINS.values() for cls in known.values() if cls.__module__ == module]


def plugins(kind: str) -> dict[str, type[Any]]:
    """Return every plug-in of `kind` by name, those it includes too, importing its folder first."""
    _import_all(FOLDERS[kind])
    included = _PLUGINS.get(INCLUDED.get(kind, ""), {})
    return dict(sorted({**included, **_PLUGINS.get(kind, {})}.items()))


@cache
def _import_all(folder: str) -> None:
    """Import every module of a package; once, because a scene asks for its plug-ins at every choice."""
    package = importlib.import_module(folder)
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"{package.__name__}.{module.name}")
