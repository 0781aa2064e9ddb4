"""A picture of moving bodies: the layout is made once, and the bodies are drawn again for every frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cqrun.figures.colours import Colours
from cqrun.figures.dots import Dots, OutlinedDots
from cqrun.figures.quantities import length_unit
from cqrun.figures.rigid import outlines, plot_rigid
from cqrun.figures.scenery import Goal, boundary_section, frame_axes, plot_boundaries, plot_goals
from cqrun.figures.solid import SolidBodies
from cqrun.figures.style import GREY, INK
from cqrun.figures.views import View
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene
from cqrun.store.rigid_motion import RigidMotions
from cqrun.units import Unit

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDEST, TALLEST, LOWEST = 6.6, 4.8, 1.2
"""Area for the bodies: largest width, largest and smallest height [inch]."""

NARROWEST = 1.8
"""Smallest width of this area [inch]."""

LEFT, RIGHT, TOP, BOTTOM = 0.75, 0.25, 0.42, 0.55
"""Margins around this area, without the colour bar [inch]."""

BAR = 0.85
"""Width of a colour bar on the right; a little less below [inch]."""


@dataclass(frozen=True)
class Trails:
    """The paths of centroids.

    Attributes:
        frames: frames of the points (K,), in order.
        paths: name -> positions (K, D) [m].
    """

    frames: Array
    paths: dict[str, Array]


@dataclass(frozen=True)
class Stage:
    """The parts that are the same in all pictures.

    Attributes:
        scene: the scene of the run.
        look, corners: the view, and its window (2, 2) [m].
        box: lower and upper corner of the bodies over the whole time (2, D) [m].
        dots: the dots that fill the bodies.
        colours: colours of the particles.
        trails: paths of the followed centroids.
        cables: the particles along each cable, in order.
        goals: the goals to mark.
        name: name of the run, for the corner.
        quantity: the quantity that the colours show.
        rigid: how rigid bodies move.
        steps: the control step of every frame.
    """

    scene: Scene
    look: View
    corners: Array
    box: Array
    dots: Dots
    colours: Colours
    trails: Trails
    cables: list[Array]
    goals: list[Goal]
    name: str
    quantity: str
    rigid: RigidMotions | None = None
    steps: Sequence[int] = ()


class Picture:
    """The picture; `show` draws a frame and returns its pixels, `close` releases the renderer.

    Axes, ticks, ground and colour bar are drawn once. Only what moves, and what lies on it, is drawn for every frame.

    Args:
        stage: the parts that are the same in all pictures.
        layers: number of instants that are shown at once.
        dpi: pixels per inch; the picture is about 8 inches wide.
    """

    def __init__(self, stage: Stage, layers: int, dpi: float) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        self.stage = stage
        self._corners = _widened(stage.corners)
        self._unit = length_unit(float(np.max(np.abs(self._corners))) if stage.look.names else _width(self._corners))
        self.figure, self.axes = _lay_out(self._corners, dpi)
        self._canvas = FigureCanvasAgg(self.figure)
        if stage.look.names:
            section = boundary_section(stage.scene, stage.look, self._corners, stage.box.mean(axis=0))
            plot_boundaries(self.axes, section, self._unit.factor)
        frame_axes(self.axes, stage.look, self._corners, self._unit)
        maker = _Solid if stage.scene.dim == 3 else _Flat
        self._bodies = maker(self.axes, stage, self._corners, self._unit, layers)
        self._rigid = plot_rigid(self.axes, self._outlines(0), self._unit.factor) if stage.scene.rigid else None
        plot_goals(self.axes, stage.goals, stage.look, self._unit.factor)
        self._trails = [
            self.axes.plot([], [], color=INK, linewidth=1.0, alpha=0.8, zorder=3, label=name)[0]
            for name in stage.trails.paths
        ]
        self._cables = [
            self.axes.plot([], [], color=INK, linewidth=1.6, marker=".", markersize=4, zorder=2.5)[0]
            for _ in stage.cables
        ]
        if not stage.look.names:
            _scale_bar(self.axes, self._corners, self._unit)
        _colour_bar(self.figure, self.axes, stage.colours)
        self._stamp = self.axes.set_title(" ", pad=7)
        self.figure.text(
            1 - 0.1 / self.figure.get_figwidth(), 1 - 0.1 / self.figure.get_figheight(), stage.name,
            ha="right", va="top", fontsize=8, color=GREY,
        )  # fmt: skip
        self._moving = self._on_bodies()
        self._still = self._drawn_once()

    def _outlines(self, frame: int) -> list[Array]:
        """Return the outlines of rigid bodies in a frame (k, 2) [m]."""
        stage = self.stage
        return outlines(stage.scene, stage.rigid, int(stage.steps[frame]), stage.look)

    def _on_bodies(self) -> list[Artist]:
        """Return what is drawn for every frame, the lowest first: the bodies, what covers them, and the title."""
        axes, lowest = self.axes, self._bodies.artist.get_zorder()
        others: list[Artist] = [axes.xaxis, axes.yaxis, axes.patch, *(() if axes.axison else axes.spines.values())]
        covering = [each for each in axes.get_children() if each.get_zorder() >= lowest and each not in others]
        return sorted(covering, key=lambda artist: artist.get_zorder())

    def _drawn_once(self) -> Any:
        """Draw what stays as it is, and return its pixels."""
        for artist in self._moving:
            artist.set_animated(True)
        self._canvas.draw()
        return self._canvas.copy_from_bbox(self.figure.bbox)

    def show(self, layers: Sequence[tuple[Array, Array]], stamp: str, frame: int) -> Array:
        """Return the picture (h, w, 3) of uint8, with even h and w.

        Args:
            layers: positions x (N, D) [m] and colours (N, 3) of each instant, the last on top.
            stamp: the title.
            frame: the frame up to which trails are drawn.
        """
        dots = self.stage.dots
        self._bodies.paint([(dots.positions(x), rgb[dots.source]) for x, rgb in layers])
        trails = self.stage.trails
        travelled = int(np.searchsorted(trails.frames, frame, side="right"))
        for line, path in zip(self._trails, trails.paths.values(), strict=True):
            line.set_data(*(self._unit.factor * path[:travelled] @ self.stage.look.axes.T).T)
        for line, route in zip(self._cables, self.stage.cables, strict=True):
            line.set_data(*(self._unit.factor * layers[-1][0][route] @ self.stage.look.axes.T).T)
        if self._rigid is not None:
            self._rigid.set_verts([self._unit.factor * polygon for polygon in self._outlines(frame)])
        self._stamp.set_text(stamp)
        self._canvas.restore_region(self._still)
        for artist in self._moving:
            self.figure.draw_artist(artist)
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()

    def close(self) -> None:
        """Release the renderer of bodies in 3D."""
        self._bodies.close()

    def __enter__(self) -> Picture:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Flat:
    """Bodies in 2D, drawn as dots."""

    def __init__(self, axes: Axes, stage: Stage, corners: Array, unit: Unit, layers: int) -> None:
        dots = OutlinedDots(axes, stage.dots, unit.factor, layers)
        self.paint, self.artist = dots.paint, dots.collection

    def close(self) -> None:
        """Do nothing: there is nothing to release."""


class _Solid:
    """Bodies in 3D: an image made by pyvista, placed in the axes."""

    def __init__(self, axes: Axes, stage: Stage, corners: Array, unit: Unit, layers: int) -> None:
        box = axes.get_window_extent()
        pixels = max(2, round(box.width)), max(2, round(box.height))
        self._bodies = SolidBodies(stage.scene, stage.look, corners, stage.box, stage.dots.size, pixels)
        (left, low), (right, high) = unit.factor * corners
        blank = np.zeros((pixels[1], pixels[0], 4))
        self.artist = axes.imshow(
            blank, extent=(left, right, low, high), origin="upper", aspect="auto", interpolation="none", zorder=1
        )
        axes.set_aspect("equal")

    def paint(self, layers: Sequence[tuple[Array, Array]]) -> None:
        self.artist.set_data(self._bodies.paint(layers))

    def close(self) -> None:
        self._bodies.close()


# --- layout -------------------------------------------------------------------------------------------------


def _width(corners: Array) -> float:
    return float(corners[1, 0] - corners[0, 0])


def _widened(corners: Array) -> Array:
    """Return a window widened so that it is neither too flat nor too narrow for a picture."""
    wide, tall = corners[1] - corners[0]
    least = np.array([tall * NARROWEST / TALLEST, wide * LOWEST / WIDEST])
    more = 0.5 * np.maximum(0.0, least - (wide, tall))
    return np.asarray(corners + np.array([-more, more]))


def _lay_out(corners: Array, dpi: float) -> tuple[Figure, Axes]:
    """Return a figure with axes in the shape of the window; its pixel counts are even, as movies require."""
    from matplotlib.figure import Figure

    wide, tall = corners[1] - corners[0]
    scale = min(WIDEST / wide, TALLEST / tall)
    width, height = scale * wide, scale * tall
    beside, below = (0.0, 0.8 * BAR) if _bar_is_below(width, height) else (BAR, 0.0)
    bottom = BOTTOM + below
    whole = 2 * np.round(np.array([LEFT + width + RIGHT + beside, TOP + height + bottom]) * dpi / 2) / dpi
    figure = Figure(figsize=tuple(whole), dpi=dpi)
    axes = figure.add_axes((LEFT / whole[0], bottom / whole[1], width / whole[0], height / whole[1]))
    return figure, axes


def _bar_is_below(width: float, height: float) -> bool:
    return height < 0.45 * width


def _colour_bar(figure: Figure, axes: Axes, colours: Colours) -> None:
    """Add the colour bar on the right, or below if the bodies are much wider than tall."""
    place = axes.get_position()
    wide, tall = figure.get_size_inches()
    if _bar_is_below(place.width * wide, place.height * tall):
        length = min(place.width, 3.2 / wide)
        spot: Any = (place.x0 + 0.5 * (place.width - length), 0.45 / tall, length, 0.11 / tall)
        orientation = "horizontal"
    else:
        length = min(place.height, 3.2 / tall)
        spot = (place.x1 + 0.2 / wide, place.y0 + 0.5 * (place.height - length), 0.12 / wide, length)
        orientation = "vertical"
    bar = figure.colorbar(colours.scale(), cax=figure.add_axes(spot), orientation=orientation, extend=colours.extend)
    bar.set_label(colours.label)
    bar.outline.set_visible(False)
    bar.ax.grid(visible=False)
    bar.ax.locator_params(nbins=5)


def _scale_bar(axes: Axes, corners: Array, unit: Unit) -> None:
    """Draw a line of a round length in the lower left corner, because an oblique view has no ticks."""
    longest = 0.2 * _width(corners)
    power = 10.0 ** np.floor(np.log10(longest))
    length = max(step * power for step in (1.0, 2.0, 5.0) if step * power <= longest)
    x, y = corners[0] + 0.03 * _width(corners)
    axes.plot(
        unit.factor * np.array([x, x + length]), unit.factor * np.array([y, y]), color=INK, linewidth=2.0,
        solid_capstyle="butt", zorder=5,
    )  # fmt: skip
    axes.annotate(
        f"{unit.factor * length:g} {unit.name}", (unit.factor * (x + 0.5 * length), unit.factor * y), xytext=(0, 3),
        textcoords="offset points", ha="center", va="bottom", fontsize=7.5, color=INK, zorder=5,
    )  # fmt: skip
