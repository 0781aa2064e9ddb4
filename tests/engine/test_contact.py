"""Contact with obstacles in the reference frame: motion against plain NumPy, and the adjoint on each side of kinks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import total_lagrangian
import touching
from little_worlds import cases, needs_jit
from rich_scene import (
    COUNTS,
    DX,
    KINDS,
    arrays,
    direction,
    moved,
    parts,
    product,
    random_records,
    random_state,
    rebuilt,
)
from test_reference_frame import DOT_PRODUCT, SLOW, STEPS, TINY, compiled, completed, held, loss
from touching import BODIES

from cqrun.boundaries.solid import CAPSULE, PLANE, Solid
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import LossBar, Records
from cqrun.engine.surface import MeetingModel, ObstacleModel, SurfaceModel

CHANGED = ("v", "C", "mass", "volume", "damping", "force", "fixed_corotated.E", "neo_hookean.nu", "viscosity.shear",
           "friction", "muscle.activation", "cable.rest")  # fmt: skip
"""The kinds of input whose derivative is compared; the others act through forces that have their own tests."""

FRICTION = [0.4, 1.5, 0.3, 0.7]
"""Coefficients of the obstacles with friction."""

POINTS, FACETS, MIDDLE = 60, 40, 0.41
"""Half of the points are where bodies meet, in the middle between them."""
STIFFNESS = {2: 20.0, 3: 1.0}
"""Of a point, by the dimension [N/m]: it stops a particle within some substeps."""


def plane(point, normal):
    """Return a half-space."""
    n = np.array(normal, float)
    return Solid(PLANE, np.array([point], float), n[None] / np.linalg.norm(n), np.zeros(0))


def ball(centre, radius):
    """Return a ball."""
    centre = np.array(centre, float)
    return Solid(CAPSULE, np.stack([centre, centre]), np.zeros((0, len(centre))), np.array([radius]))


def obstacles(dim):
    """Return a floor, a slope, two balls joined, and a wall without friction; numbers are those of `CONDITIONS`."""
    e = np.eye(dim)
    centre = 0.35 * np.ones(dim)
    return (
        ObstacleModel(0, (plane(0.27 * e[-1], e[-1]),), True, 0.8),
        ObstacleModel(1, (plane(0.45 * e[0], e[0] + e[-1]),), True),
        ObstacleModel(2, (ball(centre + 0.1 * e[0], 0.07), ball(centre + 0.15 * e[0], 0.06)), True, 0.5),
        ObstacleModel(7, (plane(0.66 * e[0], -e[0]),), False, 0.3),
    )


def touched(dim, *, viscous=True, seed=0, **options):
    """Return a rich model whose surface touches obstacles, and its inputs."""
    model, inputs = held(dim, viscous=viscous, seed=seed, **options)
    inputs.state.v[:, 0] += np.where(np.arange(len(inputs.state.x)) < COUNTS[0], 1.5, -1.0)  # towards each other
    rng = np.random.default_rng(seed + 5)
    particle = rng.integers(0, len(inputs.state.x), POINTS)
    between = np.argsort(np.abs(inputs.state.x[:, 0] - MIDDLE))[:12]
    particle[: POINTS // 2] = rng.choice(between, POINTS // 2)
    x = inputs.state.x[particle] + 0.25 * DX * rng.uniform(-1, 1, (POINTS, dim))
    x[: POINTS // 2, 0] = MIDDLE + 0.2 * DX * rng.uniform(-1, 1, POINTS // 2)
    order = np.argsort(particle >= COUNTS[0], kind="stable")
    x, particle = x[order], particle[order]
    K = STIFFNESS[dim] * rng.uniform(0.8, 1.2, POINTS)
    inputs.coefficients[:4] = FRICTION
    inputs.coefficients = np.append(inputs.coefficients, 0.3)
    area = rng.uniform(0.5, 2.0, POINTS)
    surface = SurfaceModel(x, particle, K, 2 * K * model.dt, area, random_facets(x, particle, rng))
    return replace(model, surface=surface, obstacles=obstacles(dim), meeting=MeetingModel(True, 0.5)), inputs


def random_facets(x, particle, rng):
    """Return segments or triangles of points of one body that are near each other (T, D), no two of the same points."""
    first, facets = particle < COUNTS[0], {}
    for s in rng.integers(0, len(x), FACETS):
        own = np.flatnonzero((first == first[s]) & (np.arange(len(x)) != s))
        near = own[np.argsort(np.linalg.norm(x[own] - x[s], axis=1))[:6]]
        corner = [s, *rng.choice(near, x.shape[1] - 1, replace=False)]
        facets[tuple(sorted(corner))] = corner
    return np.array(list(facets.values()))


@pytest.fixture(scope="module", params=cases(BODIES, ["2D viscous", "3D"]))
def case(request):
    """Return a model, its inputs, cotangents, the rollout and its gradient."""
    dim, viscous = request.param
    rng = np.random.default_rng(7)
    model, inputs = touched(dim, viscous=viscous, seed={2: 0, 3: 9}[dim])  # in which everything happens
    records_bar = random_records(Records.zeros(model.n_controls, 3, dim), rng)
    state_bar = random_state(inputs.state, rng)
    rollout = make_rollout(*compiled(model, inputs, viscous), adjoint=True)
    records, bar = rollout.gradient(lambda records, state: LossBar(records_bar, state_bar))
    return model, inputs, records_bar, state_bar, rollout, records, completed(bar, viscous), viscous


def test_the_motion_is_that_of_the_equations(case):
    """Every obstacle is met, and everything happens that a point can do."""
    model, inputs, _, _, rollout, records, _, _ = case
    seen: list[tuple[touching.Touching, touching.Meeting]] = []
    expected, last = total_lagrangian.rollout(model, inputs, watch=lambda *contact: seen.append(contact))
    for got, want in zip(parts(records), parts(expected), strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-11 * np.abs(want).max())
    for got, want in zip(parts(rollout.unpack(rollout.final, 0)), parts(last), strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-10 * np.abs(want).max())
    touched_, met = seen[0]
    branches = set.union(*touched_.branches)
    assert {o for o, what in branches if what == "presses"} == {0, 1, 2, 3}
    assert {what for _, what in branches} == {"presses", "leaves", "sticks", "slides"}
    assert min(met.branches[what] for what in ("leaves", "sticks", "slides", "2 corners")) > 0, met.branches
    assert met.branches["1 corners"] + met.branches["3 corners"] > 0, met.branches


@pytest.mark.parametrize("kind", CHANGED)
def test_dot_product(case, kind, rng):
    model, inputs, records_bar, state_bar, _, _, bar, viscous = case
    if kind in SLOW and not viscous:
        pytest.skip("this material has no viscosity")
    change = direction(inputs, kind, rng)
    records, last = total_lagrangian.rollout(model, moved(inputs, kind, 1j * TINY * change))
    forward = (product(records, records_bar) + product(last, state_bar)).imag / TINY
    backward = (arrays(bar)[KINDS.index(kind)] * change).sum()
    assert abs(forward) > 0
    assert backward == pytest.approx(forward, rel=DOT_PRODUCT)


@pytest.mark.parametrize("dim", [2, 3])
def test_dot_product_of_positions_at_rest(dim, rng):
    """Those of the surface's points, and of the particles with which they move."""
    model, inputs = touched(dim, viscous=False, seed={2: 0, 3: 2}[dim])
    inputs.surface, inputs.shaped = model.surface.x.copy(), True
    records_bar = random_records(Records.zeros(model.n_controls, 3, dim), rng)
    rollout = make_rollout(*compiled(model, inputs, viscous=False), adjoint=True)
    _, bar = rollout.gradient(lambda records, state: LossBar(records_bar))
    change = 0.1 * DX * rng.normal(size=inputs.surface.shape)
    shifted = moved(inputs, "v", 0j * inputs.state.v)
    shifted.surface = inputs.surface + 1j * TINY * change
    other = 0.1 * DX * rng.normal(size=inputs.state.x.shape)
    for slope, given in (
        ((bar.surface * change).sum(), shifted),
        ((bar.state.x * other).sum(), moved(inputs, "x", 1j * TINY * other)),
    ):
        records, _ = total_lagrangian.rollout(model, given)
        forward = product(records, records_bar).imag / TINY
        assert abs(forward) > 0
        assert slope == pytest.approx(forward, rel=DOT_PRODUCT)


@needs_jit
@pytest.mark.parametrize("precision", [np.float64, np.float32])
def test_any_number_of_threads_gives_the_same_bits(precision):
    model, inputs = touched(2, real=precision)
    records_bar = random_records(Records.zeros(model.n_controls, 3, 2), np.random.default_rng(1))
    found = []
    for threads in (1, 2, 3):
        rollout = make_rollout(model, inputs, threads=threads, adjoint=True)
        records, bar = rollout.gradient(lambda records, state: LossBar(records_bar))
        assert rollout.threads == threads
        found.append([a.tobytes() for a in (*parts(records), *arrays(bar))])
    assert found[0] == found[1] == found[2]


def smooth(model, dashpots=False):
    """Return a model without friction, and without dashpots: its contact depends on positions alone."""
    obstacles = tuple(replace(o, rubs=False, dashpot=o.dashpot * dashpots) for o in model.obstacles)
    return replace(model, obstacles=obstacles, meeting=MeetingModel(False, 0.5 * dashpots))


@pytest.mark.parametrize("dim", [2, 3])
def test_contact_without_friction_and_dashpots_is_reversed(dim):
    """Its motion is that of the equations, its gradient that of kept states, and so is the plan of a reversed run."""
    model, inputs = touched(dim, viscous=False, substeps=8)
    expected, _ = total_lagrangian.rollout(smooth(model), inputs)
    model, inputs = compiled(smooth(model), inputs, viscous=False)
    records_bar = random_records(Records.zeros(model.n_controls, 3, dim), np.random.default_rng(2))
    gradients = []
    for reversible in (True, False):
        rollout = make_rollout(model, inputs, adjoint=True)
        assert rollout.reversible
        rollout.reversible = reversible
        records, bar = rollout.gradient(lambda records, state: LossBar(records_bar))
        assert rollout.reversible == reversible
        for got, want in zip(parts(records), parts(expected), strict=True):
            np.testing.assert_allclose(got, want, rtol=0, atol=1e-11 * np.abs(want).max())
        gradients.append(arrays(completed(bar, viscous=False)))
    for got, want in zip(*gradients, strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-9 * np.abs(want).max())


@pytest.mark.parametrize("dashpots", [True, False], ids=["dashpots", "friction"])
def test_a_gradient_after_contact_that_loses_energy_keeps_states(dashpots):
    """It is that of a rollout that kept states from the start."""
    model, inputs = touched(2, viscous=False, substeps=8)
    model, inputs = compiled(smooth(model, dashpots) if dashpots else model, inputs, viscous=False)
    records_bar = random_records(Records.zeros(model.n_controls, 3, 2), np.random.default_rng(2))
    gradients = []
    for reversible in (True, False):
        rollout = make_rollout(model, inputs, adjoint=True)
        rollout.reversible = reversible
        _, bar = rollout.gradient(lambda records, state: LossBar(records_bar))
        gradients.append([a.tobytes() for a in arrays(completed(bar, viscous=False))])
    assert gradients[0] == gradients[1]


def test_checkpoints_carry_the_springs():
    """Memory for few states gives the gradient that memory for all of them gives."""
    model, inputs = touched(2, viscous=False, substeps=60)
    model, inputs = compiled(replace(model, dt=model.dt / 10), inputs, viscous=False)
    records_bar = random_records(Records.zeros(model.n_controls, 3, 2), np.random.default_rng(2))
    gradients = []
    for budget in (2**30, 40 * make_rollout(model, inputs).start.nbytes):
        rollout = make_rollout(replace(model, memory_budget=budget, spare=[]), inputs, adjoint=True)
        _, bar = rollout.gradient(lambda records, state: LossBar(records_bar))
        gradients.append(arrays(completed(bar, viscous=False)))
    assert rollout.plan.n_chunks > 1
    for got, want in zip(*gradients, strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-12 * np.abs(want).max())


@pytest.mark.parametrize("dim", [2, pytest.param(3, marks=needs_jit)])
@pytest.mark.parametrize("kind", ["v", "mass", "fixed_corotated.E", "friction", "force"])
def test_taylor_remainder_is_of_second_order(kind, dim, rng):
    model, inputs = touched(dim, viscous=False, substeps=8, seed=4)

    def loss_bar(records, _):
        return LossBar(rebuilt(records, [np.cos(a) + a for a in parts(records)]))

    records, bar = make_rollout(*compiled(model, inputs, viscous=False), adjoint=True).gradient(loss_bar)
    change, here = direction(inputs, kind, rng), loss(records)
    slope = (arrays(completed(bar, viscous=False))[KINDS.index(kind)] * change).sum()
    remainders = [
        abs(loss(make_rollout(*compiled(model, moved(inputs, kind, h * change), False)).run()) - here - h * slope)
        for h in STEPS[4:14]
    ]
    assert np.log2(remainders[-6] / remainders[-1]) / 5 >= 1.9, remainders
