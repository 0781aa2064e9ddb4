"""Rigid bodies of a scene: what is refused, their mass properties, and the way of values to the engine and back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from cqrun.boundaries.solid import BOX, MESH
from cqrun.build.inertia import mass_properties, principal
from cqrun.build.model import build
from cqrun.engine.model import Inputs
from cqrun.engine.rigid_model import FORCE, INERTIA, MASS, OFFSET, SPIN
from cqrun.errors import SceneError
from cqrun.geometry.ball import Ball
from cqrun.geometry.box import Box
from cqrun.geometry.cylinder import Cylinder
from cqrun.geometry.mesh import Mesh
from cqrun.jobs.rest import require_no_time
from cqrun.scene.load import load_scene
from cqrun.scene.paths import leaf

MATERIAL = {"density": 1000, "elastic": {"neo_hookean": {"youngs_modulus": 1e4, "poissons_ratio": 0.3}}}
BLOCK = {"shape": {"box": {"corner": [0.2, 0.1], "size": [0.2, 0.1]}}, "particles_per_cell": 4, "material": MATERIAL}
BALL = {"shape": {"ball": {"center": [0.3, 0.3], "radius": 0.04}}, "density": 500, "motion": "free", "friction": 0.3}
PATH = [{"time": 0.05, "displacement": [0.0, -0.01]}, {"time": 0.1, "rotation": [0.2]}]
JAW = {"shape": {"box": {"corner": [0.5, 0.1], "size": [0.1, 0.1]}}, "path": PATH}


def scene(**changes: Any) -> dict[str, Any]:
    """Return a soft block with a free ball above it, and a jaw beside it."""
    return {
        "cqrun": 1,
        "world": {"size": [1, 1], "dx": 0.02, "gravity": [0, -9.81]},
        "bodies": {"block": BLOCK},
        "boundaries": {"floor": {"friction": {"face": "y_min", "thickness": 0.1, "coefficient": 0.5}}},
        "rigid": {"ball": BALL, "jaw": JAW},
        "time": {"duration": 0.1, "control_step": 0.05},
        **changes,
    }


def with_ball(**fields: Any) -> dict[str, Any]:
    """Return the scene with other fields of the ball; None removes one."""
    ball = {key: value for key, value in (BALL | fields).items() if value is not None}
    return scene(rigid={"ball": ball, "jaw": JAW})


def with_path(*points: dict[str, Any]) -> dict[str, Any]:
    """Return the scene with another path of the jaw."""
    return scene(rigid={"jaw": JAW | {"path": list(points)}})


REFUSED = {
    "no mass": (with_ball(density=None), "rigid.ball.motion: moves freely, so it needs a `density` or a `mass`"),
    "two masses": (with_ball(mass=1.0), "rigid.ball: has a density and a mass: give one of them"),
    "a spin of a fixed body": (
        with_ball(motion="fixed", spin=[1.0]),
        "rigid.ball.spin: has no effect on a body that does not move freely: set `motion: free`, or remove it",
    ),
    "a jump": (
        with_path({"time": 0.1}, {"time": 0.1, "displacement": [0.1, 0.0]}),
        "rigid.jaw.path.1.time: a path cannot jump: it has two waypoints at 0.1 s; give the move some time",
    ),
    "a path back in time": (with_path({"time": 0.1}, {"time": 0.05}), "times must increase along a path"),
    "a path of a free body": (
        scene(rigid={"ball": BALL | {"path": PATH}}),
        "rigid.ball.path: moves freely, so it cannot follow a path: remove one of the two",
    ),
    "a rotation vector in 2D": (
        with_path({"time": 0.1, "rotation": [0.0, 0.0, 1.0]}),
        "rigid.jaw.path.0.rotation: must have one entry in this 2D world, has 3",
    ),
    "inside a soft body": (
        with_ball(offset=[0.0, -0.08]),
        "rigid.ball: starts 0.02 m inside the soft body 'block', at (0.3, 0.2) m: contact would throw them apart",
    ),
    "inside a rigid body": (
        with_ball(offset=[0.2, -0.1]),
        "rigid.ball: starts inside the rigid body 'jaw', and rigid bodies do not feel each other: move one of them",
    ),
    "the other frame": (
        scene(world={"size": [1, 1], "dx": 0.02, "frame": "updated"}),
        "rigid: rigid bodies are touched in the reference frame alone: set `world.frame: reference`",
    ),
    "float32": (scene(precision="float32"), "precision: is float32, too coarse for the small turns of 'ball'"),
    "an infinite body": (
        with_ball(shape={"half_space": {"point": [0, 0.5], "normal": [0, -1]}}),
        "rigid.ball.shape: is infinite, so the body has no mass and cannot move freely: bound it",
    ),
    "an unknown surface": (
        with_ball(shape={"difference": {"shapes": [BALL["shape"], {"ball": {"center": [0.3, 0.3], "radius": 0.02}}]}}),
        "rigid.ball.shape: the distance from the surface of 'difference' is not known, so soft bodies cannot touch it",
    ),
    "the name of a boundary": (scene(rigid={"floor": BALL}), "rigid.floor: a boundary has this name too"),
    "a start at rest": (
        scene(start="equilibrium"), "start: an equilibrium does not feel rigid bodies yet (ball, jaw): remove `start`",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_is_refused(name):
    data, message = REFUSED[name]
    with pytest.raises(SceneError) as raised:
        build(load_scene(data))
    assert message in str(raised.value)


def glued(**rigid: Any) -> dict[str, Any]:
    """Return the scene with a patch of the block glued to a rigid body, and these rigid bodies beside the jaw."""
    patch = {"sticky": {"region": {"box": {"corner": [0.38, 0.1], "size": [0.02, 0.1]}}, "to": "jaw"}}
    return scene(boundaries={"patch": patch}, rigid={"jaw": JAW} | rigid)


UNGLUED = {
    "a free body": (
        {"jaw": BALL},
        "boundaries.patch.sticky.to: the rigid body 'jaw' moves freely, and nothing can be glued to it yet",
    ),
    "an offset": ({"jaw": JAW | {"offset": [0.01, 0.0]}}, "the rigid body 'jaw' has an `offset`"),
    "a start elsewhere": (
        {"jaw": JAW | {"path": [{"time": 0.0, "displacement": [0.1, 0.0]}]}},
        "the path of 'jaw' begins elsewhere than its shape",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", UNGLUED)
def test_what_a_patch_cannot_be_glued_to_is_refused(name):
    rigid, message = UNGLUED[name]
    with pytest.raises(SceneError) as raised:
        build(load_scene(glued(**rigid)))
    assert message in str(raised.value)


def test_a_glued_patch_turns_about_the_centre_of_its_body():
    built = build(load_scene(glued()))
    np.testing.assert_allclose(built.model.centers["patch"], [0.55, 0.15])
    with pytest.raises(SceneError, match="there is no rigid body 'claw'"):
        load_scene(scene(boundaries={"patch": {"sticky": {"face": "x_min", "to": "claw"}}}))
    with pytest.raises(SceneError, match="displacement: has no effect: the rigid body 'jaw' carries it; remove it"):
        load_scene(scene(boundaries={"patch": {"sticky": {"face": "x_min", "to": "jaw", "displacement": [0.1, 0.0]}}}))


RESTLESS = {
    "friction": ({"jaw": JAW | {"friction": 0.2}}, "rigid.jaw.friction: an equilibrium feels contact without friction"),
    "a free body": ({"ball": BALL | {"friction": 0.0}}, "rigid.ball.motion: a rigid body at rest does not move freely"),
}


@pytest.mark.parametrize("name", RESTLESS)
def test_what_has_no_equilibrium_is_refused(name):
    rigid, message = RESTLESS[name]
    clamp = {"sticky": {"region": {"box": {"corner": [0.1, 0.1], "size": [0.4, 0.02]}}}}
    floor = {"separate": {"face": "y_min", "thickness": 0.09}}
    require_no_time(load_scene(scene(boundaries={"clamp": clamp, "floor": floor}, rigid={"jaw": JAW})))
    with pytest.raises(SceneError) as raised:
        require_no_time(load_scene(scene(boundaries={"clamp": clamp, "floor": floor}, rigid=rigid)))
    assert message in str(raised.value)


def test_scenes_without_rigid_bodies_do_not_mention_them():
    data = scene()
    del data["rigid"]
    plain = load_scene(data)
    assert "rigid" not in plain.model_dump(exclude_none=True)
    assert build(plain).model.rigid == ()


def test_a_free_body_bounds_the_substep_with_its_mass():
    limits = {}
    for density in (500, 5):
        built = build(load_scene(with_ball(density=density)))
        limits[density] = next(limit.dt for limit in built.limits if limit.part == "rigid.ball")
    assert limits[5] < 0.2 * limits[500]


@pytest.mark.parametrize(
    "shape",
    [
        Ball(center=[0.1, 0.2, 0.3], radius=0.05),
        Box(corner=[0.0, 0.1, 0.2], size=[0.1, 0.2, 0.3]),
        Cylinder(start=[0.0, 0.0, 0.0], end=[0.0, 0.0, 0.2], radius=0.1),
    ],
)
def test_mass_properties(shape):
    """Those of textbooks; a lattice, for shapes without a formula, comes within 1 %."""
    found = mass_properties(shape, list(shape.solids()))
    if isinstance(shape, Ball):
        volume, inertia = 4 / 3 * np.pi * 0.05**3, 0.4 * 0.05**2 * np.ones(3)
    elif isinstance(shape, Box):
        volume, inertia = 0.1 * 0.2 * 0.3, np.array([0.2**2 + 0.3**2, 0.1**2 + 0.3**2, 0.1**2 + 0.2**2]) / 12
    else:
        volume, inertia = np.pi * 0.1**2 * 0.2, np.array([0.1**2 / 4 + 0.2**2 / 12] * 2 + [0.1**2 / 2])
    exact = 1e-12
    assert found.volume == pytest.approx(volume, rel=exact)
    np.testing.assert_allclose(np.diag(found.inertia), volume * inertia, rtol=exact)
    np.testing.assert_allclose(found.center, np.mean(shape.bounds(), axis=0), rtol=1e-12, atol=1e-12)
    counted = mass_properties(shape, [])
    np.testing.assert_allclose(counted.inertia, found.inertia, rtol=0, atol=0.01 * np.abs(found.inertia).max())
    np.testing.assert_allclose(counted.center, found.center, rtol=0, atol=1e-3)
    moments, axes = principal(found.inertia)
    np.testing.assert_allclose(axes.T @ np.diag(moments) @ axes, found.inertia, rtol=0, atol=1e-3 * moments.max())


def saved(mesh: Any, path: Path, **fields: Any) -> Mesh:
    """Write a mesh, and return it as a shape."""
    mesh.export(path)
    return Mesh(file=str(path), **fields)


def test_mass_properties_of_a_mesh_are_exact(tmp_path):
    """A turned box with a box cut out of it, in millimetres; by hand, the difference of both."""
    trimesh, turn = pytest.importorskip("trimesh"), [20.0, -30.0, 40.0]
    outer, inner = trimesh.creation.box((80, 120, 40)), trimesh.creation.box((20, 40, 10))
    inner.apply_translation((16, 32, -8))
    inner.export(tmp_path / "inner.stl")
    place = {"units": "mm", "scale": 0.5, "offset": [1.0, 2.0, 3.0], "rotation": turn}
    shape = saved(outer, tmp_path / "outer.stl", **place, cavities=[str(tmp_path / "inner.stl")])
    found, R = mass_properties(shape, shape.solids()), shape.matrix(3)
    parts = [(1, np.array([80, 120, 40]), np.zeros(3)), (-1, np.array([20, 40, 10]), np.array([16.0, 32.0, -8.0]))]
    m = np.array([sign * np.prod(size * 5e-4) for sign, size, _ in parts])
    at = 5e-4 * np.array([place for _, _, place in parts])
    center = m @ at / m.sum()
    inertia = np.zeros((3, 3))
    for mass, (_, size, _), x in zip(m, parts, at - center, strict=True):
        square = (size * 5e-4) ** 2
        inertia += mass * (np.diag(square.sum() - square) / 12 + x @ x * np.eye(3) - np.outer(x, x))
    assert found.volume == pytest.approx(m.sum(), rel=1e-12)
    np.testing.assert_allclose(found.center, [1.0, 2.0, 3.0] + R @ center, rtol=1e-13)
    np.testing.assert_allclose(found.inertia, R @ inertia @ R.T, rtol=0, atol=1e-12 * inertia.max())
    ball = saved(trimesh.creation.icosphere(subdivisions=4), tmp_path / "ball.stl")
    assert mass_properties(ball, ball.solids()).volume == pytest.approx(ball.volume(), rel=1e-12)


def of_mesh(shape: dict[str, Any], **fields: Any) -> dict[str, Any]:
    """Return a soft block in 3D and a rigid body."""
    block = BLOCK | {"shape": {"box": {"corner": [0.2, 0.2, 0.1], "size": [0.2, 0.2, 0.1]}}, "particles_per_cell": 8}
    return {
        "cqrun": 1, "world": {"size": [0.6, 0.6, 0.6], "dx": 0.05, "gravity": [0, 0, -9.81]},
        "bodies": {"block": block},
        "rigid": {"part": {"shape": shape, **fields}}, "time": {"duration": 0.1, "control_step": 0.05},
    }  # fmt: skip


def test_a_free_mesh_has_the_numbers_of_its_box(tmp_path):
    """Mass, centre, inertia, bounds on the substep and the skin."""
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box((75, 100, 125)).export(tmp_path / "box.stl")
    free = {"motion": "free", "density": 800}
    mesh = {"mesh": {"file": str(tmp_path / "box.stl"), "units": "mm", "offset": [0.3, 0.3, 0.4]}}
    box = {"box": {"corner": [0.2625, 0.25, 0.3375], "size": [0.075, 0.1, 0.125]}}
    found, wanted = (build(load_scene(of_mesh(shape, **free))) for shape in (mesh, box))
    numbers = [built.assembly.inputs({}).rigid[0] for built in (found, wanted)]
    np.testing.assert_allclose(*numbers, rtol=1e-12)
    body, other = (built.model.rigid[0] for built in (found, wanted))
    np.testing.assert_allclose(body.skin, other.skin, rtol=0, atol=2e-10)  # a box counts 1e-9 of its size as inside
    np.testing.assert_allclose(body.stiffness, other.stiffness, rtol=1e-8)
    np.testing.assert_allclose(body.center, other.center, rtol=1e-13)
    assert body.radius == pytest.approx(other.radius, rel=1e-12)
    assert found.model.dt == pytest.approx(wanted.model.dt, rel=1e-8)


def test_meshes_that_soft_bodies_cannot_touch_say_why(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    names = ("holed.stl", "bowl.stl", "two.stl", "big.stl")
    files = {name: str(tmp_path / name) for name in names} | {"none.stl": str(tmp_path / "none.stl")}
    for name, kept in (("holed.stl", np.arange(1280) % 20 > 0), ("bowl.stl", ball.triangles_center[:, 2] < 0)):
        cut = ball.copy()
        cut.update_faces(kept)
        cut.export(files[name])
    trimesh.util.concatenate([ball, ball.copy().apply_translation((0.03, 0, 0))]).export(files["two.stl"])
    ball.copy().apply_scale(1000).export(files["big.stl"])
    words = {
        "holed.stl": "rigid.part.shape: the distance from the surface of 'mesh' is not known, since holed.stl has "
                     "holes (close its holes), so soft bodies cannot touch it: use a half_space",
        "bowl.stl": "has holes: for",
        "two.stl": "since two.stl has surfaces that overlap or cross (make them one), so soft bodies cannot",
        "none.stl": "rigid.part.shape.mesh.file: ",
        "big.stl": "is its file in millimetres? then give `units: mm`",
    }  # fmt: skip
    for name, message in words.items():
        with pytest.raises(SceneError) as raised:
            build(load_scene(of_mesh({"mesh": {"file": files[name], "offset": [0.3, 0.3, 0.4]}})))
        assert message in str(raised.value), name
    with pytest.raises(SceneError, match="a mesh needs a 3D world"):
        load_scene(scene(rigid={"ball": {"shape": {"mesh": {"file": files["holed.stl"]}}}}))


def test_an_obstacle_from_a_file_needs_no_normal(tmp_path):
    """The scene lies in another folder than the one in which it is checked, and a file that is not there is named."""
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box((400, 400, 80)).export(tmp_path / "plate.stl")
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(with_obstacle("plate.stl")))
    (obstacle,) = build(load_scene(tmp_path / "scene.yaml")).model.obstacles
    assert [solid.kind for solid in obstacle.solids] == [MESH, BOX]
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(with_obstacle("absent.stl")))
    with pytest.raises(SceneError, match=r"boundaries\.ground\.separate\.region.*file: .*absent\.stl: cannot be read"):
        build(load_scene(tmp_path / "scene.yaml"))


def with_obstacle(file: str) -> dict[str, Any]:
    """Return a soft block above a plate and a box."""
    plate = {"mesh": {"file": file, "units": "mm", "offset": [0.3, 0.3, 0.05]}}
    region = {"union": [plate, {"box": {"corner": [0.0, 0.0, 0.0], "size": [0.1, 0.1, 0.2]}}]}
    return of_mesh(BALL["shape"]) | {"rigid": {}, "boundaries": {"ground": {"separate": {"region": region}}}}


def test_numbers_reach_the_engine():
    built = build(load_scene(with_ball(offset=[0.01, 0.02], spin=[3.0], force=[0.5, 0.0])))
    ball, jaw = built.assembly.inputs({}).rigid
    mass = 500 * np.pi * 0.04**2
    np.testing.assert_allclose(ball[MASS], mass)
    np.testing.assert_allclose(ball[INERTIA], mass * 0.04**2 / 2)
    np.testing.assert_allclose(ball[FORCE], [0.5, -9.81 * mass, 0.0])
    np.testing.assert_allclose(ball[OFFSET], [0.01, 0.02, 0.0])
    np.testing.assert_allclose(ball[SPIN], [0.0, 0.0, 3.0])
    assert not jaw.any()
    np.testing.assert_allclose(built.assembly.inputs({}).waypoints, [[0, -0.01, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0.2]])


PATHS = (
    "rigid.ball.density", "rigid.ball.friction", "rigid.ball.offset.0", "rigid.ball.velocity.1", "rigid.ball.spin.0",
    "rigid.ball.torque.0", "rigid.ball.force.1", "rigid.jaw.offset.1", "rigid.jaw.path.0.displacement.1",
    "rigid.jaw.path.1.rotation.0", "world.gravity.1",
)  # fmt: skip


@pytest.mark.parametrize("path", PATHS)
def test_gradients_by_key_path_are_the_adjoint_of_values(path, rng):
    loaded = load_scene(scene())
    built = build(loaded)
    info = leaf(loaded, path)
    assert info.differentiable
    value = float(info.value) + 0.1
    inputs = built.assembly.inputs({path: np.array(value)})
    bar = Inputs.zeros_like(inputs)
    bar.rigid[:], bar.waypoints[:] = rng.normal(size=bar.rigid.shape), rng.normal(size=bar.waypoints.shape)
    gradient = built.assembly.gradient({path: np.array(value)}, bar)[path]
    ends = [built.assembly.inputs({path: np.array(value + h)}) for h in (-1e-4, 1e-4)]
    slope = sum(
        ((getattr(ends[1], kind) - getattr(ends[0], kind)) * getattr(bar, kind)).sum() / 2e-4
        for kind in ("rigid", "waypoints")
    )
    assert gradient == pytest.approx(slope, rel=1e-6)
    assert slope != 0


def test_a_shape_of_a_rigid_body_cannot_be_an_unknown():
    assert not leaf(load_scene(scene()), "rigid.ball.shape.ball.radius").differentiable
