"""Fibres in pictures: where they are drawn, along which direction, and not where they have no stiffness."""

from __future__ import annotations

import numpy as np
from made_runs import plane_scene

from cqrun.figures.fibres import MOST_LINES, fibres_of, plot_fibres
from cqrun.figures.style import new_figure, styled
from cqrun.figures.views import views
from cqrun.scene.load import load_scene


def layered(base: float, layer: float):
    """Return a scene whose first body has fibres of one stiffness, and of another in its left half."""
    data = plane_scene({"bodies.a.material.density": {"bounds": [500, 2000]}})
    body, two = data["bodies"]["a"], [[2.0, 0.0], [1.0, 1.0]]
    body["material"] = body["material"] | {"fibre": {"stiffness": base, "directions": two}}
    body["material_of"] = {"left": {"fibre": {"stiffness": layer, "directions": two}}}
    return load_scene(data)


def test_fibres_are_where_they_are_stiff():
    every, left, none = (fibres_of(layered(*k)) for k in ((1e4, 1e4), (0.0, 1e4), (0.0, 0.0)))
    assert none == []
    assert [len(some) for some in (every, left)] == [2, 2]
    for x, _ in left:
        assert len(x) <= MOST_LINES
        assert x[:, 0].max() < 0.045
    assert every[0][0][:, 0].max() > 0.045
    np.testing.assert_allclose([a for _, a in left], [[1.0, 0.0], [0.5**0.5, 0.5**0.5]])
    assert fibres_of(load_scene(plane_scene({"bodies.a.material.density": {"bounds": [500, 2000]}}))) == []


def test_lines_have_the_direction_of_the_fibres():
    scene = layered(0.0, 1e4)
    with styled():
        axes = new_figure(3, 2).subplots()
        (look,) = views(scene, np.zeros((1, 1, 2)))
        plot_fibres(axes, fibres_of(scene), look, np.array([[0.0, 0.2], [0.0, 0.1]]), 1e3)
    (lines,) = axes.collections
    ways = np.array([np.ptp(segment, axis=0) for segment in lines.get_segments()])
    assert np.all(np.isclose(ways[:, 1], 0.0) | np.isclose(ways[:, 1], ways[:, 0]))
    assert axes.get_legend() is not None
