"""What tests of plug-in files leave behind: nothing."""

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
    """Forget the plug-in files that are run meanwhile, and where they made kernels be cached."""
    for kind, folder in registry.FOLDERS.items():
        if find_spec(folder) is not None:
            registry.plugins(kind)  # so that what is known before is known afterwards
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "_PLUGINS", {kind: dict(known) for kind, known in registry._PLUGINS.items()})
        patch.setattr(plugin_files, "_TAKEN", {})
        patch.setattr(fingerprint, "_FOREIGN", set())
        yield
    compile.cache_kernels_in(fingerprint.set_kernel_cache())
