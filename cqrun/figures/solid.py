"""Bodies of three dimensions, by pyvista without a window: particles as spheres that hide each other."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from cqrun.errors import MissingExtra, UsageError
from cqrun.explain import listed
from cqrun.figures.scenery import held_at
from cqrun.figures.style import GREY, GROUND
from cqrun.figures.views import View
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene

SAMPLES = 72
"""Samples along the longest side of what is seen that show where boundaries hold the grid."""

COVER = 1.45
"""Diameter of a sphere in distances between dots."""

WITHOUT_DISPLAY = ("libEGL.so.1", "libOSMesa.so.8")
"""Libraries of the system by which VTK draws where there is no display."""

CLASSES = 1.15
"""Dots whose sizes differ by less than this factor are drawn of one size."""


def require_pyvista() -> Any:
    """Return pyvista, which is told to open no window.

    Raises:
        MissingExtra: the extra `viz3d` is not installed.
    """
    try:
        import pyvista
        from vtkmodules.vtkCommonCore import vtkLogger
    except ModuleNotFoundError as error:
        raise MissingExtra(
            f"a picture of three dimensions needs pyvista ({error.name} is not installed): pip install 'cqrun[viz3d]'; "
            "trajectory.h5 opens in ParaView as it is"
        ) from None
    except ImportError as error:  # VTK is there, but a library of the system is not
        raise UsageError(f"pyvista cannot be used here: {error}") from error
    if sys.platform == "linux" and not os.environ.get("DISPLAY") and not any(map(_loads, WITHOUT_DISPLAY)):
        raise UsageError(
            f"pyvista cannot draw here: there is no display, and none of {listed(WITHOUT_DISPLAY)} that could do "
            "without; install one of them (Debian and Ubuntu: libegl1)"
        )  # VTK would end the process
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)  # that there is no display is no news
    return pyvista


def _loads(library: str) -> bool:
    """Say whether a library of the system can be loaded."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


class SolidBodies:
    """The particles as one picture; `close` lets go of the renderer.

    Args:
        scene: whose boundaries are drawn in an oblique view; those of others are the axes' own.
        look, corners: from where, and what is seen (2, 2) [m].
        box: the bodies over all of the time, lower and upper corner (2, 3) [m].
        size: distance between dots (M,) [m].
        pixels: width and height of the picture.
    """

    def __init__(
        self, scene: Scene, look: View, corners: Array, box: Array, size: Array, pixels: tuple[int, int]
    ) -> None:
        pyvista = require_pyvista()
        self._plotter = pyvista.Plotter(off_screen=True, window_size=pixels)
        self._plotter.set_background("white")
        self._place_camera(look, corners, box)
        self._classes: list[tuple[Array, Any]] = []
        scale = pixels[0] / float(corners[1, 0] - corners[0, 0])
        label = np.round(np.log(size) / np.log(CLASSES))
        for each in np.unique(label):
            chosen = np.flatnonzero(label == each)
            cloud = pyvista.PolyData(np.zeros((len(chosen), 3)))
            cloud["colour"] = np.zeros((len(chosen), 3), np.uint8)
            diameter = COVER * float(size[chosen].mean()) * scale
            self._plotter.add_mesh(
                cloud, scalars="colour", rgb=True, style="points", render_points_as_spheres=True,
                point_size=diameter, ambient=0.25, diffuse=0.8, specular=0.05,
            )  # fmt: skip
            self._classes.append((chosen, cloud))
        self._ground = [] if look.names else self._add_ground(pyvista, scene, look, box)

    def paint(self, layers: Sequence[tuple[Array, Array]]) -> Array:
        """Return the picture (h, w, 4) in 0 to 1 of the dots at x (M, 3) in colours (M, 3), once a layer.

        Where nothing is, it is transparent. A later layer covers the earlier ones wherever it is: they are other
        times, not other places.
        """
        picture = self._render(*layers[0], ground=True)
        for x, rgb in layers[1:]:
            over = self._render(x, rgb, ground=False)
            picture = np.where(over[..., 3:] > 0.0, over, picture)
        return picture

    def _render(self, x: Array, rgb: Array, *, ground: bool) -> Array:
        """Return one layer (h, w, 4), red to opacity in 0 to 1."""
        for chosen, cloud in self._classes:
            cloud.points = x[chosen]
            cloud["colour"] = np.round(255 * rgb[chosen]).astype(np.uint8)
        for actor in self._ground:
            actor.visibility = ground
        self._plotter.render()
        return np.asarray(self._plotter.screenshot(return_img=True, transparent_background=True)) / 255.0

    def close(self) -> None:
        """Let go of the renderer."""
        self._plotter.close()

    def _place_camera(self, look: View, corners: Array, box: Array) -> None:
        middle = corners.mean(axis=0) @ look.axes + (box.mean(axis=0) @ look.towards) * look.towards
        away = 4.0 * float(np.linalg.norm(box[1] - box[0]) + np.linalg.norm(corners[1] - corners[0]))
        camera = self._plotter.camera
        camera.enable_parallel_projection()
        camera.position, camera.focal_point, camera.up = middle + away * look.towards, middle, look.axes[1]
        camera.parallel_scale = 0.5 * float(corners[1, 1] - corners[0, 1])
        camera.clipping_range = (0.1 * away, 2.0 * away)

    def _add_ground(self, pyvista: Any, scene: Scene, look: View, box: Array) -> list[Any]:
        """Return surface and edges of what boundaries hold near the bodies, but for what would hide them."""
        room = 0.25 * float((box[1] - box[0]).max())
        grown = np.array([box[0] - room, box[1] + room])
        step = float((grown[1] - grown[0]).max()) / SAMPLES
        up = int(np.argmax(np.abs(look.axes[1])))
        grown[:, up] = box[0, up] - 3 * step, box[1, up] + 3 * step  # a floor is a sheet, not a block
        counts = np.ceil((grown[1] - grown[0]) / step).astype(int) + 1
        places = [grown[0, k] + step * np.arange(counts[k]) for k in range(3)]
        points = np.stack([part.ravel(order="F") for part in np.meshgrid(*places, indexing="ij")], axis=1)
        inside = held_at(scene, points, look.towards).reshape(counts, order="F")
        if not inside.any():
            return []
        for axis in range(3):  # closed at its ends
            np.moveaxis(inside, axis, 0)[[0, -1]] = False
        image = pyvista.ImageData(dimensions=counts, spacing=(step,) * 3, origin=grown[0])
        surface = image.contour([0.5], scalars=inside.ravel(order="F").astype(float), compute_normals=True)
        edges = surface.extract_feature_edges(40.0)
        return [
            self._plotter.add_mesh(surface, color=GROUND, opacity=0.4, lighting=False),
            self._plotter.add_mesh(edges, color=GREY, line_width=1.0, opacity=0.6, lighting=False),
        ]
