"""What bodies of the reference frame touch, and with what: made from a scene, or refused with a reason."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cqrun.boundaries.solid import BOX, CAPSULE, PLANE, POLYGON
from cqrun.build.assembly import Assembly
from cqrun.build.model import build
from cqrun.build.particles import sample
from cqrun.build.rest_shape import Geometry
from cqrun.engine.model import Inputs
from cqrun.errors import SceneError
from cqrun.scene.load import load_scene

E, RHO, NU, DX = 1e4, 1000.0, 0.3, 0.02
MATERIAL = {"density": RHO, "elastic": {"fixed_corotated": {"youngs_modulus": E, "poissons_ratio": NU}}}
BODY = {"shape": {"box": {"corner": [0.2, 0.4], "size": [0.4, 0.1]}}, "particles_per_cell": 4, "material": MATERIAL}
FLOOR = {"floor": {"friction": {"face": "y_min", "thickness": 0.1, "coefficient": 0.3}}}
TABLE = {"box": {"corner": [0, 0], "size": [1, 0.3]}}


def scene(frame: str = "reference", **changes: Any) -> dict[str, Any]:
    """Return a bar above a floor."""
    return {
        "cqrun": 1, "world": {"size": [1, 1], "dx": DX, "frame": frame}, "bodies": {"bar": BODY}, "boundaries": FLOOR,
        "time": {"duration": 0.1, "control_step": 0.1}, **changes,
    }  # fmt: skip


def test_a_floor_is_a_plane_that_holds_no_node():
    model = build(load_scene(scene())).model
    (floor,) = model.obstacles
    (plane,) = floor.solids
    assert (floor.condition, floor.rubs, floor.dashpot, plane.kind) == (0, True, 0.1, PLANE)
    np.testing.assert_array_equal(plane.points, [[0, 0.1]])
    np.testing.assert_array_equal(plane.directions, [[0, 1]])
    assert not model.conditions[0].nodes.any()


def test_points_of_the_surface_have_a_penalty_and_the_nearest_particle():
    """5 E / dx per area, and the area of the whole surface; the state has a spring for each."""
    built = build(load_scene(scene()))
    model, surface = built.model, built.model.surface
    assert surface.stiffness.sum() == pytest.approx(5 * E / DX * 1.0, rel=1e-6)
    c = np.sqrt(E * (1 - NU) / ((1 + NU) * (1 - 2 * NU)) / RHO)
    assert surface.impedance.sum() == pytest.approx(RHO * c * 1.0, rel=1e-6)
    gaps = np.linalg.norm(built.particles.x[surface.particle] - surface.x, axis=1)
    np.testing.assert_allclose(gaps, np.sqrt(2) * DX / 4, rtol=1e-6)
    assert model.n_springs == len(surface.x)
    assert model.state_bytes == 8 * 8 * (model.n_nodes + -(-len(surface.x) // 2))


def test_all_faces_are_six_obstacles_or_four():
    walls = {"walls": {"separate": {"face": "all"}}}
    model = build(load_scene(scene(boundaries=walls))).model
    points = [obstacle.solids[0].points[0] for obstacle in model.obstacles]
    np.testing.assert_array_equal(points, [[0, 0], [1, 0], [0, 0], [0, 1]])
    assert [obstacle.condition for obstacle in model.obstacles] == [0, 1, 2, 3]
    assert model.n_springs == 0


REGIONS = {
    "box": (TABLE, [BOX]),
    "ball": ({"ball": {"center": [0.5, 0.2], "radius": 0.15}}, [CAPSULE]),
    "union": ({"union": [TABLE, {"ball": {"center": [0.5, 0.2], "radius": 0.15}}]}, [BOX, CAPSULE]),
    "half_space": ({"half_space": {"point": [0.5, 0.3], "normal": [0, 1]}}, [PLANE]),
    "polygon": ({"polygon": {"points": [[0, 0], [1, 0], [0.5, 0.3]]}}, [POLYGON]),
    "turned": ({"transformed": {"shape": {"box": {"corner": [0, 0], "size": [0.2, 0.1]}}, "angle": 30}}, [BOX]),
    "name": ("table", [BOX]),
}


@pytest.mark.parametrize("name", REGIONS)
def test_a_region_is_touched_on_its_surface(name):
    """It needs no normal."""
    region, kinds = REGIONS[name]
    boundaries = {"thing": {"separate": {"region": region}}}
    model = build(load_scene(scene(boundaries=boundaries, regions={"table": TABLE}))).model
    assert [solid.kind for solid in model.obstacles[0].solids] == kinds


@pytest.mark.parametrize("region", [TABLE, "table"])
def test_the_updated_frame_needs_a_normal(region):
    boundaries = {"thing": {"separate": {"region": region}}}
    with pytest.raises(SceneError, match=r"boundaries\.thing\.separate.*needs `normal`"):
        build(load_scene(scene("updated", boundaries=boundaries, regions={"table": TABLE})))


def test_a_body_that_starts_inside_an_obstacle_is_refused():
    boundaries = {"table": {"separate": {"region": {"box": {"corner": [0, 0], "size": [0.3, 0.42]}}}}}
    with pytest.raises(SceneError) as raised:
        build(load_scene(scene(boundaries=boundaries)))
    assert "boundaries.table.separate: the body 'bar' starts 0.02 m inside it" in str(raised.value)


def test_a_body_that_starts_on_an_obstacle_is_accepted():
    boundaries = {"table": {"separate": {"region": {"box": {"corner": [0, 0], "size": [1, 0.4]}}}}}
    assert build(load_scene(scene(boundaries=boundaries))).model.obstacles


def test_contact_shortens_the_substep():
    """To .53 dx / c without a dashpot; a large dashpot shortens it further, and too few substeps are refused."""
    limits = {}
    for dashpot in (0.0, 1.0):
        floor = {"floor": {"friction": {"face": "y_min", "coefficient": 0.3, "dashpot": dashpot}}}
        built = build(load_scene(scene(boundaries=floor)))
        limits[dashpot] = {limit.part: limit.dt for limit in built.limits}
    wave, contact = limits[0.0]["bodies.bar.material"], limits[0.0]["boundaries.floor.friction"]
    assert 0.5 * wave < contact < 0.56 * wave
    assert 0.5 * contact < limits[1.0]["boundaries.floor.friction"] < 0.8 * contact
    time = {"duration": 0.1, "control_step": 0.1, "substeps": int(0.1 / (0.9 * wave))}
    with pytest.raises(SceneError, match=r"boundaries\.floor\.friction"):
        build(load_scene(scene(time=time)))


def test_lighter_bodies_get_shorter_substeps():
    """The bound follows a density among the unknowns down to the end of its bounds."""
    data = {"job": "sysid", "objective": {"there": {"reach": {"body": "bar", "position": [0.5, 0.5]}}}}
    data |= {"optimizer": {"lbfgs": {"max_iterations": 1}}}
    data |= {"unknowns": {"bodies.bar.material.density": {"bounds": [RHO / 4, RHO]}}}
    floor = {"floor": {"separate": {"face": "y_min", "dashpot": 0.0}}}
    plain, lighter = (build(load_scene(scene(boundaries=floor, **more))) for more in ({}, data))
    assert lighter.model.substeps == pytest.approx(2 * plain.model.substeps, rel=0.03)


# --- bodies that meet ------------------------------------------------------------------------------------------------

OTHER = BODY | {"place": {"offset": [0.0, 0.2]}}


def test_two_bodies_meet_each_other():
    """Facets of both surfaces, with the indices of their points; friction between them follows that of boundaries."""
    built = build(load_scene(scene(bodies={"bar": BODY, "other": OTHER})))
    model, surface = built.model, built.model.surface
    assert (model.meeting.rubs, model.meeting.dashpot) == (False, 0.1)
    half = len(surface.x) // 2
    assert sorted({tuple(corner >= half) for corner in surface.facets}) == [(False, False), (True, True)]
    np.testing.assert_array_equal(np.bincount(surface.facets.ravel()), 2)
    np.testing.assert_array_equal(built.assembly.inputs({}).coefficients, [0.3, 0.0])
    assert model.n_springs == len(surface.x)


def test_friction_between_bodies_is_a_value_with_a_gradient():
    path = "world.contact.coefficient"
    built = build(load_scene(scene(bodies={"bar": BODY, "other": OTHER}, **contact(0.2))))
    inputs = built.assembly.inputs({path: np.array(0.7)})
    np.testing.assert_array_equal(inputs.coefficients, [0.3, 0.7])
    assert built.model.n_springs == 2 * len(built.model.surface.x)
    bar = Inputs.zeros_like(inputs)
    bar.coefficients[:] = [2.0, 5.0]
    assert built.assembly.gradient({path: np.array(0.7)}, bar)[path] == 5.0


def contact(coefficient: float) -> dict[str, Any]:
    """Return a world whose bodies meet with friction."""
    return {"world": {"size": [1, 1], "dx": DX, "frame": "reference", "contact": {"coefficient": coefficient}}}


def test_bodies_that_meet_get_shorter_substeps_than_a_floor_asks_for():
    """The springs of both surfaces act; a soft body beside a stiff one bears all of its own."""
    hard = OTHER | {"material": MATERIAL | {"elastic": {"fixed_corotated": {"youngs_modulus": 100 * E,
                                                                            "poissons_ratio": NU}}}}  # fmt: skip
    found = {}
    for name, other in (("alike", OTHER), ("harder", hard)):
        limits = build(load_scene(scene(bodies={"bar": BODY, "other": other}))).limits
        found[name] = [limit.dt for limit in limits if limit.part in ("boundaries.floor.friction", "bodies")][:2]
    (floor, alike), (_, harder) = found["alike"], found["harder"]
    assert 0.6 * floor < alike < 0.9 * floor
    assert harder < 0.9 * alike


def test_contact_between_bodies_belongs_to_the_reference_frame():
    world = {"size": [1, 1], "dx": DX, "frame": "updated", "contact": {"coefficient": 0.2}}
    with pytest.raises(SceneError, match=r"world\.contact: acts in the reference frame alone"):
        build(load_scene(scene(world=world)))


# --- a surface that follows the shape --------------------------------------------------------------------------------

TURNED = BODY | {"place": {"offset": [0.1, 0.2], "angle": 20.0, "scale": 1.1}}
NUMBERS = {"shape.box.size.0": 0.46, "shape.box.corner.1": 0.37, "place.angle": 35.0, "place.offset.0": 0.16}


@pytest.mark.parametrize("name", NUMBERS)
def test_points_follow_the_shape(name):
    """They lie on the surface of the changed body, like the particles inside it."""
    path, value = f"bodies.bar.{name}", NUMBERS[name]
    before, after = (load_scene(scene(bodies={"bar": TURNED}), overrides) for overrides in ([], [f"{path}={value}"]))
    x = Geometry(before, sample(before)).surface_at_rest({path: np.array(value)})
    whole, centre = after.bodies["bar"].whole(), x.mean(axis=0)
    assert whole.inside(centre + (1 - 1e-6) * (x - centre)).all()
    assert not whole.inside(centre + (1 + 1e-6) * (x - centre)).any()
    assert len(Geometry(before, sample(before)).surface_at_rest({})) == 0


@pytest.mark.parametrize("name", NUMBERS)
def test_dot_product_of_points_that_follow_the_shape(name, rng):
    path, value = f"bodies.bar.{name}", NUMBERS[name]
    one = load_scene(scene(bodies={"bar": TURNED}))
    assembly = Assembly(one, sample(one))
    values = {path: np.array(value)}
    bar = Inputs.zeros_like(assembly.inputs(values))
    bar.surface[:] = rng.normal(size=bar.surface.shape)
    step = 1e-4 * abs(value)
    ahead, behind = (assembly.inputs({path: np.array(value + sign * step)}).surface for sign in (1, -1))
    differences = ((ahead - behind) * bar.surface).sum() / (2 * step)
    assert assembly.gradient(values, bar)[path] == pytest.approx(differences, rel=1e-6)
