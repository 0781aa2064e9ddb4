"""Particles follow the numbers in the shape and place of their body, and gradients by these numbers are right."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cqrun.build.assembly import Assembly
from cqrun.build.particles import sample
from cqrun.build.rest_shape import Geometry, replaced
from cqrun.errors import MissingExtra, UsageError
from cqrun.geometry.shape import counted_volume
from cqrun.scene.load import load_scene
from cqrun.scene.paths import leaf, leaves, shapes_a_body, with_values
from cqrun.scene.schema import Scene

BAR = {"start": [0, 0, 0], "end": [1, 0.5, 0.2], "radius": 0.3}
TAPER = {"start": [0, 0, 0], "end": [1, 0.5, 0.2], "start_radius": 0.4, "end_radius": 0.2}
HILLS = {"amplitude": 0.25, "wavelength": 1.0, "base": 0.5, "phase": 20}
BOX = {"box": {"corner": [0.2, 0.1], "size": [1, 2]}}
DISC = {"ball": {"center": [0, 1], "radius": 1}}
BOX_3D = {"box": {"corner": [0.1, 0, -1], "size": [1, 2, 0.5]}}
SHAPES: dict[str, tuple[int, dict[str, Any]]] = {
    "rectangle": (2, {"shape": BOX}),
    "box": (3, {"shape": BOX_3D}),
    "disc": (2, {"shape": DISC}),
    "ball": (3, {"shape": {"ball": {"center": [1, 2, 3], "radius": 0.5}}}),
    "stadium": (2, {"shape": {"capsule": {"start": [0, 0], "end": [1, 0.5], "radius": 0.3}}}),
    "capsule": (3, {"shape": {"capsule": BAR}}),
    "tapered capsule": (3, {"shape": {"capsule": {**BAR, "end_radius": 0.15}}}),
    "tapered stadium": (
        2,
        {"shape": {"capsule": {"start": [0, 0], "end": [1, 0.5], "radius": 0.1, "end_radius": 0.4}}},
    ),
    "cylinder": (3, {"shape": {"cylinder": BAR}}),
    "cone": (3, {"shape": {"cone": TAPER}}),
    "trapezoid": (2, {"shape": {"cone": {**TAPER, "start": [0, 0], "end": [1, 0.5]}}}),
    "polygon": (2, {"shape": {"polygon": {"points": [[0, 0], [2.1, 0], [2, 1.05], [1.13, 1], [1, 2], [0, 2.07]]}}}),
    "hills": (2, {"shape": {"height_field": {"sinusoid": HILLS, "span": [0.2, 2.7], "bottom": -1}}}),
    "union": (2, {"shape": {"union": {"shapes": [DISC, BOX], "scale": 1.2, "offset": [0.1, 0.2]}}}),
    "transformed": (2, {"shape": {"transformed": {"shape": BOX, "angle": 30, "offset": [1, 0.2], "scale": 1.3}}}),
    "turned": (3, {"shape": {"transformed": {"shape": BOX_3D, "rotation": [0, 40, 20]}}}),
    "difference": (2, {"shape": {"difference": [{"box": {"corner": [-1, 0], "size": [2, 1]}}, DISC]}}),
    "intersection": (2, {"shape": {"intersection": [BOX, DISC]}}),
    "parts": (2, {"parts": {"low": BOX, "high": {"box": {"corner": [0.2, 2.1], "size": [1, 1]}}}}),
    "placed": (2, {"shape": BOX, "place": {"scale": 0.2, "offset": [0.7, 0.7], "angle": 0}}),
    "placed in space": (3, {"shape": BOX_3D, "place": {"scale": 0.2, "offset": [0.7] * 3, "rotation": [0, 0, 0]}}),
}


def scene_of(name: str, **more: Any) -> Scene:
    """Return a scene with one body, which is small and in the middle of the world unless it has a place."""
    dim, body = SHAPES[name]
    material = {"density": 900.0, "elastic": {"neo_hookean": {"youngs_modulus": 1.0e4, "poissons_ratio": 0.3}}}
    body = {"place": {"scale": 0.2, "offset": [0.7] * dim}, "spacing": 0.04, "material": material, **body}
    body |= {"spin": [3.0] * (1 if dim == 2 else 3)}
    world = {"size": [1.6] * dim, "dx": 0.08, "frame": "updated"}
    time = {"duration": 0.01, "control_step": 0.01}
    return load_scene({"cqrun": 1, "world": world, "bodies": {"a": body}, "time": time, **more})


def numbers_of(scene: Scene) -> dict[str, np.ndarray]:
    """Return the numbers that particles follow, at their values in the scene."""
    paths = [path for path in leaves(scene, differentiable=True) if shapes_a_body(path)]
    return {path: np.array(float(leaf(scene, path).value)) for path in paths}


@pytest.fixture(scope="module", params=SHAPES)
def scene(request) -> Scene:
    """Return one scene after another."""
    return scene_of(request.param)


def test_unchanged_numbers_move_nothing(scene):
    particles, numbers = sample(scene), numbers_of(scene)
    assert numbers
    x, volume = Geometry(scene, particles).at_rest(numbers)
    np.testing.assert_allclose(x, particles.x, rtol=0, atol=1e-14)
    np.testing.assert_allclose(volume, particles.volume, rtol=1e-13)


@pytest.mark.parametrize("name", [name for name in SHAPES if name not in ("difference", "intersection")])
def test_particles_fill_the_new_shape(name):
    """The volume of the shape grows like the volumes of the particles, to the accuracy of a lattice."""
    scene = scene_of(name)
    particles, numbers = sample(scene), numbers_of(scene)
    measure = scene.bodies["a"].whole().volume()
    for path, value in numbers.items():
        changed = {path: float(value) + 0.1 * (abs(float(value)) or 1.0)}
        x, volume = Geometry(scene, particles).at_rest({path: np.array(changed[path])})
        whole = with_values(scene, changed).bodies["a"].whole()
        middle = x.mean(axis=0)
        assert whole.inside(middle + (1 - 1e-9) * (x - middle)).all(), path
        if name not in ("union", "parts"):  # their parts overlap: particles in both follow the first part
            expected = whole.volume() / measure
            assert volume.sum() / particles.volume.sum() == pytest.approx(expected, rel=0.03), path


def test_volumes_grow_by_the_determinant(scene):
    particles, body = sample(scene), scene.bodies["a"]
    points, step = particles.points["a"], 1e-7
    for path, value in numbers_of(scene).items():
        keys = path.split(".")[2:]
        if keys[0] == "place":
            continue
        to = replaced(body, keys, float(value) + 0.2 * (abs(float(value)) or 1.0))
        for k, (shape, shape_to) in enumerate(zip(body.pieces.values(), to.pieces.values(), strict=True)):
            x = points.local[points.piece == k]
            columns = []
            for axis in np.eye(scene.dim):
                ahead, behind = (shape.carried(x + sign * step * axis, shape_to)[0] for sign in (1, -1))
                columns.append((ahead - behind) / (2 * step))
            growth = shape.carried(x, shape_to)[1]
            det = np.linalg.det(np.stack(columns, axis=2))
            seam = np.abs(det / growth - 1) > 1e-6  # where two pieces of the map meet
            assert seam.mean() < 0.2, path


def test_dot_product_of_every_number(scene, rng):
    """Compare positions, volumes, masses and spin velocities with differences of fourth order."""
    assembly, numbers = Assembly(scene, sample(scene)), numbers_of(scene)
    base = assembly.inputs({})
    x_bar, v_bar = rng.normal(size=base.state.x.shape), rng.normal(size=base.state.v.shape)
    mass_bar, volume_bar = rng.normal(size=(2, len(base.fields.mass)))

    def measured(values: dict[str, np.ndarray]) -> float:
        inputs = assembly.inputs(values)
        moved = np.vdot(inputs.state.x, x_bar) + np.vdot(inputs.state.v, v_bar)
        return float(moved + inputs.fields.mass @ mass_bar / base.fields.mass.mean()
                     + inputs.fields.volume @ volume_bar / base.fields.volume.mean())  # fmt: skip

    bar = type(base).zeros_like(base)
    bar.state.x, bar.state.v = x_bar, v_bar
    bar.fields.mass, bar.fields.volume = mass_bar / base.fields.mass.mean(), volume_bar / base.fields.volume.mean()
    start = {path: value + 0.02 for path, value in numbers.items()}
    gradient = assembly.gradient(start, bar)
    for path, value in start.items():
        h = 1e-3
        at = {k: measured({**start, path: value + k * h}) for k in (-2, -1, 1, 2)}
        slope = (8 * (at[1] - at[-1]) - (at[2] - at[-2])) / (12 * h)
        assert abs(float(gradient[path]) - slope) <= 1e-9 * max(abs(slope), np.abs(at[1])), path


def test_particles_do_not_follow_the_numbers_of_a_cutting_shape():
    paths = numbers_of(scene_of("difference"))
    assert any(".shapes.0." in path for path in paths)
    assert not any(".shapes.1." in path for path in paths)


def test_a_jittered_particle_outside_a_union_follows_its_own_part():
    """Otherwise it would follow the last part, away from its neighbours."""
    ball, box = {"ball": {"center": [0.5, 0.5], "radius": 0.2}}, {"box": {"corner": [1.0, 0.3], "size": [0.2, 0.4]}}
    body = {"shape": {"union": [ball, box]}, "sampling": {"jittered": {"amount": 0.5}}}
    loaded = scene_of("union", bodies={"a": {**scene_of("disc").model_dump(exclude_none=True)["bodies"]["a"], **body,
                                             "place": None, "spacing": 0.02}})  # fmt: skip
    particles = sample(loaded)
    of_ball = particles.x[:, 0] < 0.8
    assert not loaded.bodies["a"].whole().inside(particles.x[of_ball]).all()
    moved, _ = Geometry(loaded, particles).at_rest({"bodies.a.shape.union.shapes.0.ball.center.0": np.array(0.55)})
    np.testing.assert_allclose(moved - particles.x, np.outer(of_ball, [0.05, 0.0]), atol=1e-12)


def test_a_hole_moves_and_stretches_with_its_shape():
    loaded = scene_of("difference")
    particles = sample(loaded)
    path = "bodies.a.shape.difference.shapes.0.box.size.0"
    moved, volume = Geometry(loaded, particles).at_rest({path: np.array(3.0)})
    local = (moved - 0.7) / 0.2
    np.testing.assert_allclose(local[:, 0], 1.5 * ((particles.x[:, 0] - 0.7) / 0.2 + 1.0) - 1.0, atol=1e-12)
    hole = loaded.bodies["a"].pieces["shape"].shapes[1].value
    assert hole.inside(local).any()  # where the hole was
    assert volume.sum() == pytest.approx(1.5 * particles.volume.sum())


def test_particles_do_not_follow_other_boxes():
    """The box of a group, a region or a boundary does not move particles."""
    floor = {"sticky": {"region": {"box": {"corner": [0, 0], "size": [2, 0.3]}}}}
    reached = list(leaves(scene_of("rectangle", boundaries={"floor": floor}), differentiable=True))
    assert not any("region" in path for path in reached)


def test_a_polygon_that_crosses_itself_is_refused():
    scene = scene_of("polygon")
    crossed = scene.bodies["a"].pieces["shape"].model_copy(update={"points": [[0, 0], [2, 2], [2, 0], [0, 2]]})
    with pytest.raises(UsageError, match="must not cross or touch itself"):
        crossed.carried(np.zeros((1, 2)), crossed)


def test_polygons_without_shapely(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "shapely", None)
    shape = scene_of("polygon").bodies["a"].pieces["shape"]
    with pytest.raises(MissingExtra, match=r"shapely, which is not installed: pip install 'cqrun\[polygon\]'"):
        shape.carried(np.zeros((1, 2)), shape)


@pytest.mark.parametrize("name", ["disc", "capsule", "tapered capsule", "cone", "difference"])
def test_fitted_particles_follow_their_shape(name):
    """They have the volume of the shape before and, to the accuracy of the lattice, after its numbers change."""
    dim, body = SHAPES[name]
    scene = scene_of(name)
    body = {**scene.model_dump(exclude_none=True)["bodies"]["a"], "sampling": {"lattice": {"fitted": True}}}
    scene = scene_of(name, bodies={"a": body})
    particles, numbers = sample(scene), numbers_of(scene)
    measure = 0.2**dim * counted_volume(scene.bodies["a"].whole().shape.value)
    thin = name == "difference"  # it tapers to nothing, and its tips are far from all particles
    assert particles.volume.sum() == pytest.approx(measure, rel=0.02 if thin else 0.005)
    assert len(np.unique(particles.volume.round(12))) > 1
    for path, value in numbers.items():
        changed = {path: float(value) + 0.1 * (abs(float(value)) or 1.0)}
        x, volume = Geometry(scene, particles).at_rest({path: np.array(changed[path])})
        whole = with_values(scene, changed).bodies["a"].whole()
        if name != "difference":  # holes stretch with the first shape
            assert volume.sum() / whole.volume() == pytest.approx(1.0, rel=0.01), path
            assert whole.inside(x).all(), path
