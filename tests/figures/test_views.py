"""Views of a world, and dots that look like a body."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from made_runs import plane_scene

from cqrun.errors import UsageError
from cqrun.figures.choices import Look
from cqrun.figures.dots import Dots
from cqrun.figures.scenery import frame_axes
from cqrun.figures.style import new_figure, styled
from cqrun.figures.views import view
from cqrun.scene.load import load_scene
from cqrun.units import Unit

LONG_X = np.array([[0.0, 0.0, 0.0], [3.0, 1.0, 2.0]])


def space(gravity):
    """Return a 3D scene."""
    material = {"density": 1000.0, "elastic": {"neo_hookean": {"youngs_modulus": 2e5, "poissons_ratio": 0.4}}}
    bodies = {"a": {"shape": {"ball": {"center": [0.05] * 3, "radius": 0.02}}, "particles_per_cell": 8}}
    bodies["a"]["material"] = material
    world = {"size": [0.1] * 3, "dx": 0.01, "gravity": gravity}
    return load_scene({"cqrun": 1, "world": world, "bodies": bodies, "time": {"duration": 0.1, "control_step": 0.01}})


@pytest.mark.parametrize("gravity", [[0, 0, -9.81], [0, -9.81, 0], [0, 0, 9.81], [0, 0, 0]])
@pytest.mark.parametrize("name", get_args(Look))
def test_the_eye_is_in_the_direction_of_the_name(gravity, name):
    up = np.array([0, 1, 0] if gravity[1] else [0, 0, -1 if gravity[2] > 0 else 1])
    look = view(space(gravity), LONG_X, name)
    frame = np.vstack([look.axes, look.towards])
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
    expected = {"front": [1, 0, 0], "top": up}
    if name in expected:
        np.testing.assert_allclose(look.towards, expected[name], atol=1e-12)
    elif name == "side":
        np.testing.assert_allclose(look.axes, [[1, 0, 0], up])
    else:
        assert look.towards @ up > 0.3
        assert look.axes[1] @ up > 0.9
    assert bool(look.names) == (name != "iso")


@pytest.mark.parametrize(("x", "names"), [(0.95, "xy"), (0.8, "zy")])
def test_nearly_equal_sides_are_viewed_along_z(x, names):
    assert view(space([0, -9.81, 0]), np.array([[0.0, 0.0, 0.0], [x, 0.3, 1.0]]), "side").names == names


def test_a_plane_has_one_view():
    with pytest.raises(UsageError, match="--view front: the world of this run has two dimensions"):
        view(load_scene(plane_scene({})), LONG_X, "front")


def test_ticks_are_world_coordinates_even_if_the_axis_points_left():
    look = view(space([0, -9.81, 0]), LONG_X, "front")
    assert (look.names, look.axes[0].tolist()) == ("zy", [0, 0, -1])
    with styled():
        figure = new_figure(3, 3)
        axes = figure.add_subplot()
        frame_axes(axes, look, np.array([[-0.4, 0.0], [0.0, 0.4]]), Unit("m", 1.0))
        figure.draw_without_rendering()
    labels = [label.get_text() for label in axes.get_xticklabels()]
    label_at = dict(zip(map(float, axes.get_xticks()), labels, strict=True))
    assert label_at[-0.2] == "0.2"
    assert label_at[0.0] == "0"


def lattice(counts, steps):
    grid = np.meshgrid(*(step * np.arange(n) for n, step in zip(counts, steps, strict=True)), indexing="ij")
    return np.stack([part.ravel() for part in grid], axis=1)


@pytest.mark.parametrize(
    ("counts", "steps", "each", "size"),
    [
        ((6, 5), (0.1, 0.1), 1, 0.1),
        ((30, 3), (0.1, 0.1), 1, 0.1),
        ((5, 4, 6), (0.1, 0.1, 0.1), 1, 0.1),
        ((8, 8), (0.1, 0.3), 3, 0.1),
        ((5, 5, 5), (0.3, 0.2, 0.1), 6, 0.1),
        ((9, 1), (0.1, 0.1), 1, 0.1),
    ],
)
def test_dots_fill_a_lattice_evenly(counts, steps, each, size):
    x = lattice(counts, steps)
    dots = Dots.of(x, {"a": slice(0, len(x))})
    np.testing.assert_array_equal(dots.source, np.repeat(np.arange(len(x)), each))
    np.testing.assert_allclose(dots.size, size)
    F = np.eye(len(counts)) + 0.2 * np.arange(len(counts) ** 2).reshape(len(counts), -1)
    rest = dots.positions(x)
    np.testing.assert_allclose(dots.positions(x @ F.T + 7), rest @ F.T + 7)  # dots move with the body
    low, high = rest.min(axis=0), rest.max(axis=0)
    half = 0.5 * np.array([s if n > 1 else 0.0 for n, s in zip(counts, steps, strict=True)])
    assert (low >= -half - 1e-12).all()  # no dot is outside the cell of its particle
    assert (high <= x.max(axis=0) + half + 1e-12).all()


@pytest.mark.parametrize(
    ("counts", "most", "step"),
    [
        ((20, 20, 20), 7999, 2), ((20, 20, 20), 1000, 2), ((20, 20, 20), 999, 3), ((7, 20, 3), 100, 2),
        ((250, 199), 40_000, 2), ((90, 90, 1), 1000, 3), ((1, 500, 1), 100, 5),
    ],
)  # fmt: skip
def test_thinned_dots_are_evenly_spaced(counts, most, step):
    """Without whole layers a body would seem to have holes, seams and eroded edges."""
    x = lattice(counts, (0.1,) * len(counts))
    parts = {"a": slice(0, len(x))}
    dots = Dots.of(x, parts)
    assert dots.thinned(x, parts, len(x)) is dots
    few = dots.thinned(x, parts, most)
    np.testing.assert_allclose(few.size, step * 0.1)
    at = few.positions(x)
    assert len(at) == np.prod([-(-n // step) for n in counts]) <= most
    for axis, n in enumerate(counts):
        np.testing.assert_allclose(np.unique(at[:, axis].round(9)), 0.1 * np.arange(0, n, step))


def test_every_body_keeps_its_part_of_the_dots():
    """One grid for all bodies would remove the dots of fine bodies, and of a skin on another body."""
    fine, skin, coarse = (lattice(n, (h, h)) for n, h in (((60, 60), 0.01), ((60, 1), 0.01), ((40, 40), 0.1)))
    x = np.concatenate([fine, skin - [0, 0.01], 100 + coarse])
    parts = {"fine": slice(0, 3600), "skin": slice(3600, 3660), "coarse": slice(3660, 5260)}
    few = Dots.of(x, parts).thinned(x, parts, 1400)
    counts = [np.count_nonzero((few.source >= part.start) & (few.source < part.stop)) for part in parts.values()]
    assert counts == [900, 30, 400]
    np.testing.assert_allclose(few.size, np.repeat([0.02, 0.02, 0.2], counts))
    assert len(Dots.of(x, parts).thinned(x, parts, 1).source) == 3  # one per body remains


def test_dot_sizes_belong_to_each_body_and_a_single_particle_gets_the_mean(rng):
    grid = lattice((5, 5), (1.0, 1.0))
    x = np.concatenate([grid, 100 + 0.2 * grid, [[50.0, 50.0]]])
    dots = Dots.of(x, {"a": slice(0, 25), "b": slice(25, 50), "c": slice(50, 51)})
    np.testing.assert_allclose(dots.size, [*[1.0] * 25, *[0.2] * 25, 0.6])
    assert (Dots.of(np.zeros((3, 2)), {"a": slice(0, 3)}).size > 0).all()


def test_random_particles_have_dots_as_large_as_the_gaps(rng):
    x = rng.random((4000, 2))
    dots = Dots.of(x, {"a": slice(0, 4000)})
    np.testing.assert_array_equal(dots.positions(x), x)
    assert np.median(dots.size) == pytest.approx(4000**-0.5, rel=0.2)
