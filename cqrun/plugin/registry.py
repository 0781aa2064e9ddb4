"""Plug-ins by kind and name: one file in one folder, found by importing that folder.

A plug-in file registers its class with `@plugin(kind, name)`; nothing else has to change for
`cqrun describe`, the scene schema and the generated tests to know it.
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
    "measurement": "cqrun.measurements",
    "optimizer": "cqrun.optimizers",
}
"""Where the plug-ins of each kind live."""

INCLUDED = {"region": "shape"}
"""Kinds that take the plug-ins of another as well: every shape is a region, unless a region has its name."""

_PLUGINS: dict[str, dict[str, type[Any]]] = {}
_GIVING_WAY: set[str] = set()

T = TypeVar("T", bound=type[Any])


def plugin(kind: str, name: str) -> Callable[[T], T]:
    """Register a class as the plug-in `name` of `kind` (class decorator)."""
    if kind not in FOLDERS:
        raise ValueError(f"unknown kind of plug-in '{kind}'; kinds are {', '.join(FOLDERS)}")

    def register(cls: T) -> T:
        known = _PLUGINS.setdefault(kind, {})
        other = known.setdefault(name, cls)
        if _identity(other) != _identity(cls) and other.__module__ not in _GIVING_WAY:
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
def changes(giving_way: Iterable[str] = ()) -> Iterator[None]:
    """Register plug-ins meanwhile, all of them or, where an error leaves this context, none.

    Args:
        giving_way: modules whose plug-ins' names may be taken: files of earlier scenes, among them what a file was
            before it was changed.
    """
    before = {kind: dict(known) for kind, known in _PLUGINS.items()}
    _GIVING_WAY.update(giving_way)
    try:
        yield
    except BaseException:
        _PLUGINS.clear()
        _PLUGINS.update(before)
        raise
    finally:
        _GIVING_WAY.clear()


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
