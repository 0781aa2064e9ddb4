"""Draw bodies in 3D with pyvista, without a window: particles are spheres that hide each other."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from cqrun.errors import MissingExtra, UsageError
from cqrun.explain import listed
from cqrun.figures.scenery import inside_boundaries
from cqrun.figures.style import GREY, GROUND
from cqrun.figures.views import View
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene

SAMPLES = 72
"""Number of samples along the longest side of the visible region, at which boundaries are evaluated."""

COVER = 1.45
"""Diameter of a sphere divided by the distance between dots."""

WITHOUT_DISPLAY = ("libEGL.so.1", "libOSMesa.so.8")
"""System libraries with which VTK can draw without a display."""

CLASSES = 1.15
"""Dots whose sizes differ by less than this factor are drawn with the same size."""


def require_pyvista() -> Any:
    """Return pyvista if it can draw without a window.

    Raises:
        MissingExtra: the extra `viz3d` is not installed.
        UsageError: a system library is missing.
    """
    try:
        import pyvista
        from vtkmodules.vtkCommonCore import vtkLogger
    except ModuleNotFoundError as error:
        raise MissingExtra(
            f"a picture in 3D needs pyvista ({error.name} is not installed): pip install 'cqrun[viz3d]'; or open "
            "trajectory.h5 in ParaView"
        ) from None
    except ImportError as error:  # VTK is installed, but a system library is missing
        raise UsageError(f"pyvista cannot be used here: {error}") from error
    if sys.platform == "linux" and not os.environ.get("DISPLAY") and not any(map(_loads, WITHOUT_DISPLAY)):
        raise UsageError(
            f"pyvista cannot draw here: there is no display, and none of {listed(WITHOUT_DISPLAY)}, which work "
            "without one; install one of them (Debian and Ubuntu: libegl1)"
        )  # otherwise VTK would end the process
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)  # no warnings about the missing display
    return pyvista


def _loads(library: str) -> bool:
    """Return whether a system library can be loaded."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


class SolidBodies:
    """The particles as one picture; `close` releases the renderer.

    Args:
        scene: the scene, whose boundaries are drawn in an oblique view only.
        look, corners: the view, and its window (2, 2) [m].
        box: lower and upper corner of the bodies over the whole time (2, 3) [m].
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
        """Return the picture (h, w, 4), 0 to 1, of layers of dots at x (M, 3) with colours (M, 3).

        Empty pixels are transparent. A later layer covers the earlier ones, whatever the depth, because layers are
        different times.
        """
        picture = self._render(*layers[0], ground=True)
        for x, rgb in layers[1:]:
            over = self._render(x, rgb, ground=False)
            picture = np.where(over[..., 3:] > 0.0, over, picture)
        return picture

    def _render(self, x: Array, rgb: Array, *, ground: bool) -> Array:
        """Return one layer (h, w, 4): red, green, blue and opacity, 0 to 1."""
        for chosen, cloud in self._classes:
            cloud.points = x[chosen]
            cloud["colour"] = np.round(255 * rgb[chosen]).astype(np.uint8)
        for actor in self._ground:
            actor.visibility = ground
        self._plotter.render()
        return np.asarray(self._plotter.screenshot(return_img=True, transparent_background=True)) / 255.0

    def close(self) -> None:
        """Release the renderer."""
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
        """Return surface and edges of the boundaries near the bodies, without those that would hide the bodies."""
        room = 0.25 * float((box[1] - box[0]).max())
        grown = np.array([box[0] - room, box[1] + room])
        step = float((grown[1] - grown[0]).max()) / SAMPLES
        up = int(np.argmax(np.abs(look.axes[1])))
        grown[:, up] = box[0, up] - 3 * step, box[1, up] + 3 * step  # a floor is drawn as a sheet and not as a block
        counts = np.ceil((grown[1] - grown[0]) / step).astype(int) + 1
        places = [grown[0, k] + step * np.arange(counts[k]) for k in range(3)]
        points = np.stack([part.ravel(order="F") for part in np.meshgrid(*places, indexing="ij")], axis=1)
        inside = inside_boundaries(scene, points, look.towards).reshape(counts, order="F")
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
