"""Plug-ins by kind and name: one file in one folder, found by importing that folder.

A plug-in file registers its class with `@plugin(kind, name)`; nothing else has to change for
`cqrun describe`, the scene schema and the generated tests to know it.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
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
    "controller": "cqrun.controllers",
    "observer": "cqrun.observers",
    "objective": "cqrun.objectives",
    "constraint": "cqrun.constraints",
    "optimizer": "cqrun.optimizers",
}
"""Where the plug-ins of each kind live."""

INCLUDED = {"region": "shape"}
"""Kinds that take the plug-ins of another as well: every shape is a region, unless a region has its name."""

_PLUGINS: dict[str, dict[str, type[Any]]] = {}

T = TypeVar("T", bound=type[Any])


def plugin(kind: str, name: str) -> Callable[[T], T]:
    """Register a class as the plug-in `name` of `kind` (class decorator)."""
    if kind not in FOLDERS:
        raise ValueError(f"unknown kind of plug-in '{kind}'; kinds are {', '.join(FOLDERS)}")

    def register(cls: T) -> T:
        known = _PLUGINS.setdefault(kind, {})
        if known.setdefault(name, cls).__qualname__ != cls.__qualname__:
            raise ValueError(f"two plug-ins of kind '{kind}' are called '{name}'")
        known[name] = cls
        cls.kind, cls.name = kind, name
        return cls

    return register


def plugins(kind: str) -> dict[str, type[Any]]:
    """Return every plug-in of `kind` by name, those it includes too, importing its folder first."""
    package = importlib.import_module(FOLDERS[kind])
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"{package.__name__}.{module.name}")
    included = _PLUGINS.get(INCLUDED.get(kind, ""), {})
    return dict(sorted({**included, **_PLUGINS.get(kind, {})}.items()))
