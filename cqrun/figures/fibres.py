"""Fibres in pictures: short lines along their directions, at some of the particles that have them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from cqrun.build.particles import sample
from cqrun.figures.views import View
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_LINES, LENGTH = 50, 0.03
"""Number of lines for each direction of a body, at most, and their length as a part of the window's width."""

COLOUR, WIDTH = "white", 1.0
"""Of the lines; a darker edge lets them stand out from bright bodies, too."""


def fibres_of(scene: Scene) -> list[tuple[Array, Array]]:
    """Return where a scene has fibres that are stiff, and their directions.

    For each direction of a body: the positions of some particles at rest (n, D) [m], and the unit vector (D,).
    """
    found: list[tuple[Array, Array]] = []
    if not any("fibre" in body.material.terms for body in scene.bodies.values()):
        return found
    particles, rng = sample(scene), np.random.default_rng(0)
    for name, body in scene.bodies.items():
        term: Any = body.material.terms.get("fibre")
        if term is None:
            continue
        x = particles.x[particles.of(name)]
        stiffness = np.full(len(x), term.stiffness)
        for region, other in body.material_of.items():
            value = other.value("fibre.stiffness")
            if value is not None:
                stiffness[particles.points[name].named(region)] = value
        shown = np.sort(rng.permutation(np.flatnonzero(stiffness > 0))[:MOST_LINES])
        if len(shown):
            found += [(x[shown], np.array(a) / np.linalg.norm(a)) for a in term.directions]
    return found


def plot_fibres(axes: Axes, fibres: list[tuple[Array, Array]], look: View, corners: Array, factor: float) -> None:
    """Draw fibres at rest in the plane of a view, with a legend.

    Args:
        axes: axes to draw in.
        fibres: those of `fibres_of`.
        look: the view.
        corners: window of the view (2, 2) [m].
        factor: of the unit of lengths.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.patheffects import Normal, Stroke

    half = 0.5 * LENGTH * float(corners[1, 0] - corners[0, 0])
    ends = [np.stack([x - half * a, x + half * a], axis=1) @ look.axes.T for x, a in fibres]
    if not ends:
        return
    lines = LineCollection(
        list(factor * np.concatenate(ends)), colors=COLOUR, linewidths=WIDTH, label="fibres",
        path_effects=[Stroke(linewidth=2.2 * WIDTH, foreground="black", alpha=0.6), Normal()],
    )  # fmt: skip
    axes.add_collection(lines)
    if look.names:
        axes.legend(handles=[lines], loc="lower right", fontsize=7, frameon=True, facecolor="#AAAAAA")
