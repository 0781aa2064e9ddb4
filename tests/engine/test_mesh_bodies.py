"""Rigid bodies and obstacles that are triangle meshes: against plain NumPy, against boxes, and what is conserved."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import total_lagrangian
from gripping import Gripping
from rich_scene import KINDS, arrays, direction, moved, parts, product
from scipy.spatial.transform import Rotation
from test_contact import compiled, completed
from test_reference_frame import DOT_PRODUCT, TINY
from test_rigid_bodies import RIGID, all_of, direction_of, gripped, moved_rigid, random_bar
from test_rigid_physics import momenta

from cqrun.boundaries.solid import BOX, CAPSULE, MESH, Solid, make_solids, signed_distance
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import LossBar
from cqrun.engine.rigid_model import FORCE, TORQUE
from cqrun.geometry.mesh_tree import mesh_numbers

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("igl")


def bumpy(center: np.ndarray, radius: float) -> Solid:
    """Return a ball with dents: inside, edges and corners are nearest to some points."""
    mesh = trimesh.creation.icosphere(subdivisions=1)
    dents = np.where(np.arange(len(mesh.vertices)) % 3 == 0, 0.75, 1.0)[:, None]
    numbers = mesh_numbers(np.array(mesh.vertices) * dents, np.array(mesh.faces))
    return Solid(MESH, np.zeros((1, 3)), np.eye(3), numbers).placed(radius, np.eye(3), center)


def meshed(part: Any) -> Any:
    """Return an obstacle or a rigid body with dented balls in place of balls."""
    solids = (bumpy(s.points[0], 1.1 * float(s.lengths[0])) if s.kind == CAPSULE else s for s in part.solids)
    return replace(part, solids=tuple(solids))


def gripped_by_meshes() -> tuple[Any, Any]:
    """Return a rich model in 3D of which all balls are meshes, and its inputs."""
    model, inputs = gripped(3, viscous=False, seed=9)
    obstacles, rigid = (tuple(meshed(part) for part in each) for each in (model.obstacles, model.rigid))
    return replace(model, obstacles=obstacles, rigid=rigid), inputs


@pytest.fixture(scope="module")
def case():
    """Return a model, its inputs, cotangents, the records and the gradient."""
    model, inputs = gripped_by_meshes()
    records_bar, state_bar = random_bar(model, inputs, np.random.default_rng(7))
    rollout = make_rollout(*compiled(model, inputs, False), adjoint=True)
    records, bar = rollout.gradient(lambda records, state: LossBar(records_bar, state_bar))
    return model, inputs, records_bar, state_bar, records, completed(bar, False)


def test_the_motion_is_that_of_the_equations(case):
    model, inputs, _, _, records, _ = case
    seen: list[Gripping] = []
    expected, _ = total_lagrangian.rollout(model, inputs, watch=lambda touching, _: seen.append(touching))
    for got, want in zip(parts(records), parts(expected), strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-10 * np.abs(want).max())
    for kind in ("held", "rigid"):
        for name, want in getattr(expected, kind).items():
            assert np.abs(want).max() > 0
            np.testing.assert_allclose(getattr(records, kind)[name], want.real, rtol=0, atol=1e-9 * np.abs(want).max())
    branches = set.union(*seen[0].branches)
    assert {k for k, what in branches if what == "presses"} >= set(range(4, 8)), branches
    assert {"sticks", "slides"} <= {what for k, what in branches if k >= 4}, branches


def slow(name: str) -> Any:
    """Return a case that is not of meshes alone; the equations take minutes in NumPy."""
    return pytest.param(name, marks=pytest.mark.slow)


@pytest.mark.parametrize("name", ["offset", "waypoints", slow("velocity"), slow("friction"), slow("mass")])
def test_dot_product_of_rigid_bodies(case, name, rng):
    model, inputs, records_bar, state_bar, _, bar = case
    change = direction_of(inputs, name, 3, rng)
    records, last = total_lagrangian.rollout(model, moved_rigid(inputs, name, 1j * TINY * change))
    forward = (all_of(records, records_bar) + product(last, state_bar)).imag / TINY
    backward = ((bar.waypoints if name == "waypoints" else bar.rigid[:, RIGID[name]]) * change).sum()
    assert abs(forward) > 0
    assert backward == pytest.approx(forward, rel=DOT_PRODUCT)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["friction", slow("v")])
def test_dot_product_of_soft_bodies(case, kind, rng):
    model, inputs, records_bar, state_bar, _, bar = case
    change = direction(inputs, kind, rng)
    shifted = moved(inputs, kind, 1j * TINY * change)
    shifted.rigid, shifted.waypoints = inputs.rigid.astype(complex), inputs.waypoints.astype(complex)
    records, last = total_lagrangian.rollout(model, shifted)
    forward = (all_of(records, records_bar) + product(last, state_bar)).imag / TINY
    assert abs(forward) > 0
    assert (arrays(bar)[KINDS.index(kind)] * change).sum() == pytest.approx(forward, rel=DOT_PRODUCT)


def test_dented_balls_are_met_at_faces_edges_and_corners(rng):
    table, x = make_solids([bumpy(np.zeros(3), 1.0)]), rng.uniform(-0.9, 0.9, (800, 3))
    inside = [found for p in x if (found := signed_distance(table, 0, tuple(p)))[0] < 0]
    kinds = {("face" if alpha == 0 else "edge" if any(t) else "corner") for _, _, alpha, t in inside}
    assert kinds == {"face", "edge", "corner"}


def test_soft_bodies_and_meshes_exchange_momentum_exactly():
    model, inputs = gripped_by_meshes()
    inputs.rigid, inputs.waypoints = inputs.rigid[:2], inputs.waypoints[:0]
    inputs.rigid[:, FORCE], inputs.rigid[:, TORQUE], inputs.fields.force[:] = 0.0, 0.0, 0.0
    inputs.fields.damping[:], inputs.strength[:] = 0.0, 0.0
    still = tuple(replace(c, nodes=np.zeros_like(c.nodes)) for c in model.conditions)
    model = replace(model, rigid=model.rigid[:2], obstacles=(), meeting=None, conditions=still, reactions=("stone",))
    rollout = make_rollout(*compiled(model, inputs, viscous=False))
    records = rollout.run()
    before, after = (momenta(model, inputs, rollout, q) for q in (rollout.start, rollout.final))
    assert np.abs(records.held["stone"]).max() > 1e-3
    np.testing.assert_allclose(after, before, rtol=0, atol=1e-13 * np.abs(before).max())


# --- boxes -----------------------------------------------------------------------------------------------------------


def boxed(part: Any, as_mesh: bool) -> Any:
    """Return an obstacle or a rigid body with turned boxes in place of balls, or with meshes of these boxes."""
    R, out = Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix(), []
    for solid in part.solids:
        if solid.kind != CAPSULE:
            out.append(solid)
            continue
        half = float(solid.lengths[0]) * np.array([0.8, 1.0, 0.6])
        if as_mesh:
            mesh = trimesh.creation.box(2.0 * half).subdivide()
            one = Solid(MESH, np.zeros((1, 3)), np.eye(3), mesh_numbers(np.array(mesh.vertices), np.array(mesh.faces)))
            out.append(one.placed(1.0, R, solid.points[0]))
        else:
            out.append(Solid(BOX, solid.points[:1], R.T, half))
    return replace(part, solids=tuple(out))


def test_meshes_of_boxes_act_as_boxes():
    """The same motion, forces and gradients: of obstacles, fixed bodies, one on a path and free ones that spin."""
    found = []
    for as_mesh in (False, True):
        model, inputs = gripped(3, viscous=False, seed=9)
        obstacles, rigid = (tuple(boxed(part, as_mesh) for part in each) for each in (model.obstacles, model.rigid))
        model = replace(model, obstacles=obstacles, rigid=rigid)
        bars, _ = random_bar(model, inputs, np.random.default_rng(3))
        rollout = make_rollout(*compiled(model, inputs, False), adjoint=True)
        records, bar = rollout.gradient(lambda records, state, bars=bars: LossBar(bars))
        bar = completed(bar, False)
        found.append([*parts(records), *records.held.values(), *records.rigid.values(), *arrays(bar), bar.rigid,
                      bar.waypoints])  # fmt: skip
    assert all(np.abs(held).max() > 0 for held in records.held.values())
    for k, (plain, mesh) in enumerate(zip(*found, strict=True)):
        np.testing.assert_allclose(mesh, plain, rtol=0, atol=1e-9 * np.abs(plain).max(), err_msg=str(k))
