"""Pictures of a design.

design.png   designed quantities as colours on the body, at rest and at its largest displacement; a row for each
shape.png    the bodies before and after the design, if the geometry changed
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cqrun.build.particles import sample
from cqrun.build.rest_shape import Geometry
from cqrun.figures.bodies import MOST_DOTS, PANEL, Snapshot, farthest_frame, plot_body, snapshots, window_of
from cqrun.figures.colours import MATERIAL, Colours, material_of
from cqrun.figures.dots import Dots
from cqrun.figures.quantities import length_unit, shown_unit
from cqrun.figures.run_data import RunData
from cqrun.figures.style import AMOUNT_MAP, COLOURS, GREY, new_figure
from cqrun.figures.views import of_equal_width, room_around, views, window
from cqrun.plugin.contract import Array
from cqrun.scene.paths import canonical, shapes_a_body
from cqrun.scene.unknowns import body_of, start, tied
from cqrun.store.result import values_in

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def designed_quantities(run: RunData) -> dict[str, Array]:
    """Return the quantities of MATERIAL that the unknowns of a run vary between particles, (N,) each.

    They are NaN in bodies whose values the unknowns do not change.
    """
    if not values_in(run.result):
        return {}
    particles = sample(run.scene)
    paths = [path for unknown, spec in run.scene.unknowns.items() for path in (unknown, *spec.also)]
    designed = {}
    for name, (key, *_) in MATERIAL.items():
        bodies = {body_of(run.scene, canonical(run.scene, path)) for path in paths if path.endswith(f".{key}")}
        if bodies:
            designed[name] = np.full(len(particles.x), np.nan)
            values = material_of(run, particles, name)
            for body in bodies:
                designed[name][particles.of(body)] = values[particles.of(body)]
    return {name: values for name, values in designed.items() if np.nanmin(values) < np.nanmax(values)}


def has_new_shape(run: RunData) -> bool:
    """Return whether the unknowns of a run change the shape of a body."""
    return bool(_shape_before(run))


def _shape_before(run: RunData) -> dict[str, float]:
    """Return the start values of the geometric unknowns and of the values tied to them, by path."""
    unknowns = values_in(run.result)
    paths = [path for path in run.scene.unknowns if canonical(run.scene, path) in unknowns]
    starts = [tied(run.scene, path, start(run.scene, path)) for path in paths if run.scene.unknowns[path].per == "body"]
    return {path: value for each in starts for path, value in each.items() if shapes_a_body(path)}


def draw_shape(run: RunData) -> Figure:
    """Return the picture of a design with a new shape (`has_new_shape`): before and after."""
    from matplotlib.colors import to_rgb

    with run.frames() as frames:
        (after,) = snapshots(frames, [0])
    particles = sample(run.scene)
    x, _ = Geometry(run.scene, particles).at_rest({path: np.array(v) for path, v in _shape_before(run).items()})
    bodies = {name: particles.of(name) for name in run.scene.bodies}
    fill = Dots.of(x, bodies).thinned(x, bodies, MOST_DOTS)
    before = Snapshot(0, 0.0, x, fill, after.provenance)
    both = np.concatenate([before.x, after.x])
    looks = views(run.scene, both)
    windows = of_equal_width([window(both, look, room_around(both, after.dots.size)) for look in looks])
    tall = [PANEL * float(np.clip((w[1, 1] - w[0, 1]) / (w[1, 0] - w[0, 0]), 0.25, 2.2)) for w in windows]
    figure = new_figure(2 * PANEL + 0.4, sum(tall) + 0.35 * len(looks) + 0.75)
    panels, unit = figure.subplots(len(looks), 2, squeeze=False, height_ratios=tall), length_unit(float(np.max(both)))
    for axes, title in zip(panels[0], ("before", "designed"), strict=True):
        axes.set_title(title)
    for row, look, corners in zip(panels, looks, windows, strict=True):
        for axes, shot, colour in zip(row, (before, after), (GREY, COLOURS[0]), strict=True):
            plot_body(axes, run.scene, shot, look, corners, unit, np.tile(to_rgb(colour), (len(shot.x), 1)))
        row[1].tick_params(labelleft=False)
        row[1].set_ylabel("")
    figure.suptitle(run.name, fontsize=9, color=GREY, x=0.995, ha="right")
    return figure


def draw_design(run: RunData, shown: dict[str, Array]) -> Figure:
    """Return the picture of some designed quantities (`designed_quantities`)."""
    with run.frames() as frames:
        shots = snapshots(frames, [0, farthest_frame(frames)])
    x = np.stack([shot.x for shot in shots])
    look = views(run.scene, x)[0]
    corners = window_of(run.scene, shots, look)
    tall = PANEL * float(np.clip((corners[1, 1] - corners[0, 1]) / (corners[1, 0] - corners[0, 0]), 0.25, 2.2))
    figure = new_figure(2 * PANEL + 1.3, (tall + 0.5) * len(shown) + 0.5)
    panels, unit = figure.subplots(len(shown), 2, squeeze=False), length_unit(float(np.max(corners)))
    for axes, title in zip(panels[0], ("at rest", f"t = {shots[1].time:.4g} s"), strict=True):
        axes.set_title(title)
    for row, (name, values) in zip(panels, shown.items(), strict=True):
        label, unit_name = MATERIAL[name][1:]
        scale = shown_unit(unit_name, float(np.nanmax(values)))
        shown_values = scale.factor * values
        low, high = float(np.nanmin(shown_values)), float(np.nanmax(shown_values))
        scheme = Colours(scale.label(label), low, high, AMOUNT_MAP, lambda _, values=shown_values: values)  # type: ignore[misc]
        for axes, shot in zip(row, shots, strict=True):
            plot_body(axes, run.scene, shot, look, corners, unit, scheme.rgb(shot.frame))
        row[1].tick_params(labelleft=False)
        row[1].set_ylabel("")
        bar = figure.colorbar(scheme.scale(), ax=row, shrink=0.85, pad=0.015, aspect=20)
        bar.set_label(scheme.label)
        bar.outline.set_visible(False)
    figure.suptitle(run.name, fontsize=9, color=GREY, x=0.995, ha="right")
    return figure
