"""Isolate tests that load plug-in files from all others."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

import pytest

from cqrun import fingerprint
from cqrun.numerics import compile
from cqrun.plugin import registry
from cqrun.scene import plugin_files

DISC = '''\
"""A disc, as a user might write it."""

import numpy as np

from cqrun.plugin.contract import quantity, vector
from cqrun.geometry.shape import Shape
from cqrun.plugin.registry import plugin


@plugin("shape", "disc")
class Disc(Shape):
    """Points within `radius` of `middle`."""

    middle: list[float] = vector("m", "Middle")
    radius: float = quantity("m", "Radius", gt=0)

    def inside(self, points):
        return np.sum((points - np.array(self.middle)) ** 2, axis=1) <= self.radius**2

    def bounds(self):
        return np.array(self.middle) - self.radius, np.array(self.middle) + self.radius
'''
"""A plug-in file without kernels."""


@contextmanager
def sandbox() -> Iterator[None]:
    """Forget the plug-in files that are loaded inside this context, and reset the cache folder of the kernels."""
    for kind, folder in registry.FOLDERS.items():
        if find_spec(folder) is not None:
            registry.plugins(kind)  # load all built-in plug-ins first, so that they stay registered
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "_PLUGINS", {kind: dict(known) for kind, known in registry._PLUGINS.items()})
        patch.setattr(plugin_files, "_LOADED", {})
        patch.setattr(fingerprint, "_PLUGIN_MODULES", set())
        yield
    compile.cache_kernels_in(fingerprint.set_kernel_cache())
