"""Equilibrium: where beams rest, the tangent, and gradients by the implicit function theorem against differences."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
from little_worlds import STRESSES, Acting, Wall, below, cases, needs_jit, world
from test_reference_frame import ELASTIC, SHEAR

from cqrun.actuators import cable, tension
from cqrun.boundaries.sticky import Sticky
from cqrun.engine.frames import make_rollout
from cqrun.engine.lattice import Lattice
from cqrun.engine.model import GroupModel, LossBar, Records
from cqrun.engine.reference.rollout import ReferenceRollout
from cqrun.engine.statics.equilibrium import Equilibrium
from cqrun.engine.statics.krylov import conjugate_gradients, dot
from cqrun.engine.statics.newton import find_rest
from cqrun.engine.statics.path import RestPath
from cqrun.errors import RunError
from cqrun.state import State

DX = 0.1


def cantilever(dim, *, gravity=-4.0, real=np.float64, uneven=0.0, walls=(), slit=False):
    """Return a clamped beam of two laws with a muscle, a taut cable and one with a tension, and its inputs.

    A lattice has many nodes of equal fill, and the ghost penalty takes the least of four, which is a kink. Particles
    that are moved by the part `uneven` of a cell have none. A slit of 0.6 cells leads down from the top.
    """
    rng = np.random.default_rng(3)
    counts = (14, 4, 4)[:dim]
    axes = [0.225 + 0.05 * np.arange(count) for count in counts]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, dim)
    n, volume = len(x), 0.05**dim
    top = np.flatnonzero(np.all(x[:, 1:] > x[:, 1:].max(axis=0) - 1e-9, axis=1))
    route = top[[4, 8, 13]]
    below_top = np.flatnonzero(np.all(x[:, 1:] < x[:, 1:].min(axis=0) + 1e-9, axis=1))[[3, 7, 12]]
    x = x + uneven * DX * np.random.default_rng(11).normal(size=x.shape)
    x[(x[:, 0] > 0.6) & (x[:, -1] > 0.25), 0] += 0.06 * slit
    length = float(np.linalg.norm(np.diff(x[route], axis=0), axis=1).sum())
    up = np.zeros(dim)
    up[-1] = gravity
    model, inputs = world(
        x, size=[1.4] * dim, dx=DX, dt=1e-3, substeps=1, controls=1, mass=1000 * volume, volume=volume,
        E=rng.uniform(3e4, 5e4, n), nu=rng.uniform(0.2, 0.4, n), neo_hookean=rng.uniform(3e4, 5e4, n),
        incompressible=rng.uniform(1e3, 2e3, n), gravity=up, probe=rng.random((2, n)) / n,
        walls=[Wall(Sticky, (0.0,) * dim, below(0, 0.3)), *walls],
        muscles=((np.flatnonzero(x[:, 1] > 0.3), np.diag(np.eye(dim)[0])),),
        actuators=(Acting(cable.CableKernel, route, np.zeros(0), length),
                   Acting(tension.TensionKernel, below_top, np.zeros(0))),
        activation=np.array([[0.7, 0.97, 0.8]]), real=real,
    )  # fmt: skip
    inputs.terms = [[inputs.terms[0][k] for k in (0, 1, 3)]]
    group = GroupModel((0,), ELASTIC, STRESSES, shear=(SHEAR[0], SHEAR[1], SHEAR[3]))
    lattice = Lattice(x, np.full(1, 0.05)) if slit else None
    kinds = [a.kernel for a in model.actuators]
    inputs.strength[kinds.index(STRESSES[0])] = 2e3
    inputs.strength[kinds.index(cable.CableKernel)] = 100.0 * 0.05 ** (dim - 2)
    inputs.strength[kinds.index(tension.TensionKernel)] = 5.0 * 0.05 ** (dim - 2)
    return replace(model, frame="reference", groups=(group,), lattice=lattice), inputs


CASES = {
    "2D": (2, False, False), "3D": (3, False, False), "2D averaged": (2, True, False), "3D averaged": (3, True, False),
    "2D averaged, with a slit": (2, True, True), "3D with a slit": (3, False, True),
}  # fmt: skip
"""Name -> dimension, whether volumes are averaged, and whether there is a slit."""


FAST = ("2D", "3D averaged", "2D averaged, with a slit", "3D with a slit")
"""Cases in which each pair of choices occurs."""


@pytest.fixture(scope="module", params=cases(CASES, FAST))
def rested(request):
    """Return a cantilever's model, inputs, equilibrium and rest."""
    dim, averaged, slit = request.param
    model, inputs = cantilever(dim, slit=slit)
    model = replace(model, averaged=averaged)
    equilibrium = Equilibrium(model, inputs)
    assert bool(len(equilibrium.rollout.rest.patches.split)) == slit
    return model, inputs, equilibrium, equilibrium.solve(tolerance=1e-12)


@pytest.mark.parametrize("dim", [2, 3])
def test_blocks_of_averaged_volumes_need_no_entry_of_every_direction(dim):
    """SciPy leaves out entries of a product that cancel to 0, as those of a regular lattice may."""
    model, inputs = cantilever(dim)
    equilibrium = Equilibrium(replace(model, averaged=True), inputs)
    equilibrium.linearise(equilibrium.still)
    volumes = equilibrium.volumes
    volumes.rows.data[7] = 0.0
    volumes.rows.eliminate_zeros()
    blocks = np.zeros((equilibrium.n_nodes, dim, dim))
    volumes.add_blocks(blocks)
    b = volumes.rows.toarray().reshape(-1, equilibrium.n_nodes, dim)
    np.testing.assert_allclose(blocks, np.einsum("c,cni,cnj->nij", volumes.stiffness, b, b), rtol=1e-12, atol=1e-9)


def test_it_rests_where_its_motion_dies_out(rested):
    """The same forces in motion, with damping."""
    model, inputs, _, rest = rested
    assert rest.converged
    moving = copy.deepcopy(inputs)
    moving.fields.damping[:] = 6.0
    rollout = ReferenceRollout(replace(model, substeps=9000, dt=1e-3), moving)
    rollout.run()
    u, v = rollout.final
    assert np.abs(v).max() < 1e-7
    assert np.abs(rest.u).max() > 0.02
    np.testing.assert_allclose(u, rest.u, rtol=0, atol=1e-7 * np.abs(rest.u).max())


def test_the_tangent_is_the_slope_of_the_forces_and_symmetric(rested, rng):
    _, _, equilibrium, rest = rested
    active = equilibrium.run.nodes.active

    def direction():
        p = np.zeros_like(rest.u)
        p[active, : equilibrium.dim] = rng.normal(size=(len(active), equilibrium.dim))
        return equilibrium.holding.freed(p) * 1e-2

    p, q, h = direction(), direction(), 1e-4
    equilibrium.linearise(rest.u)
    Kp, Kq = equilibrium.product(p).copy(), equilibrium.product(q).copy()
    assert dot(q, Kp) == pytest.approx(dot(p, Kq), rel=1e-12)
    ends = [equilibrium.net(rest.u + k * h * p).copy() for k in (-2, -1, 1, 2)]
    slope = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * h)
    np.testing.assert_allclose(-slope, Kp, rtol=0, atol=2e-8 * np.abs(Kp).max())


def loss_of(equilibrium, u):
    """Return a curved loss of the record at u, and its cotangent."""
    record = equilibrium.record(u)
    return float(np.sin(3 * record).sum()), 3 * np.cos(3 * record)


KINDS = {
    "E": lambda inputs: inputs.terms[0][0][0],
    "nu": lambda inputs: inputs.terms[0][0][1],
    "nu of neo-Hookean": lambda inputs: inputs.terms[0][1][1],
    "force": lambda inputs: inputs.fields.force,
    "activation": lambda inputs: inputs.activation,
    "strength": lambda inputs: inputs.strength,
    "cable rest": lambda inputs: inputs.rest,
    "volume": lambda inputs: inputs.fields.volume,
}
PLACES = KINDS | {"x": lambda inputs: inputs.state.x}


@pytest.mark.parametrize("kind", KINDS)
def test_the_gradient_is_that_of_differences(rested, kind, rng):
    model, inputs, equilibrium, rest = rested
    _, bar = loss_of(equilibrium, rest.u)
    gradient, _ = equilibrium.gradient(rest.u, record_bar=bar, tolerance=1e-13)
    value = KINDS[kind](inputs)
    # a lattice has many nodes of equal fill, and the ghost penalty takes the least of four: a kink
    change = 0.5 * value if kind == "volume" else rng.normal(size=value.shape) * np.abs(value)
    slope = (KINDS[kind](gradient) * change).sum()
    losses = []
    for k in (-2, -1, 1, 2):
        there = copy.deepcopy(inputs)
        KINDS[kind](there)[...] += k * 1e-4 * change
        moved = Equilibrium(model, there)
        losses.append(loss_of(moved, moved.solve(rest.u, tolerance=1e-13).u)[0])
    difference = (losses[0] - 8 * losses[1] + 8 * losses[2] - losses[3]) / 12e-4
    assert abs(difference) > 0
    assert slope == pytest.approx(difference, rel=1e-7)


def test_the_gradient_of_a_state_is_that_of_its_record(rested):
    """A record is a weighted sum of particles, so a state's cotangent can say the same."""
    model, _, equilibrium, rest = rested
    _, bar = loss_of(equilibrium, rest.u)
    by_record, _ = equilibrium.gradient(rest.u, record_bar=bar)
    W, dim = model.probe.toarray(), model.dim
    spread = bar @ W
    x_bar, v_bar, C_bar, F_bar = np.split(spread, np.cumsum([dim, dim, dim**2]))
    state_bar = State(x_bar.T, v_bar.T, C_bar.T.reshape(-1, dim, dim), F_bar.T.reshape(-1, dim, dim))
    by_state, _ = equilibrium.gradient(rest.u, state_bar=state_bar)
    np.testing.assert_allclose(by_state.fields.force, by_record.fields.force, rtol=0,
                               atol=1e-8 * np.abs(by_record.fields.force).max())  # fmt: skip


def test_reactions_carry_all_loads(rested):
    _, inputs, equilibrium, rest = rested
    total = equilibrium.reactions(rest.u).sum(axis=0)
    np.testing.assert_allclose(total, -inputs.fields.force.sum(axis=0), rtol=0, atol=1e-9 * np.abs(total).max())


@needs_jit
def test_any_number_of_threads_gives_the_same_bits():
    model, inputs = cantilever(2)
    found = []
    for threads in (1, 2, 3):
        equilibrium = Equilibrium(model, inputs, threads=threads)
        assert equilibrium.rollout.threads == threads
        rest = equilibrium.solve()
        bar, _ = equilibrium.gradient(rest.u, record_bar=loss_of(equilibrium, rest.u)[1])
        found.append((rest.u.tobytes(), bar.terms[0][0].tobytes(), bar.activation.tobytes()))
    assert found[0] == found[1] == found[2]


def test_a_large_load_is_found_in_one_step():
    """Ten times the weight that bends it by a tenth: Newton's steps are shortened, not refused."""
    model, inputs = cantilever(2, gravity=-60.0)
    rest = Equilibrium(model, inputs).solve()
    assert rest.converged
    assert not rest.negative
    assert np.abs(rest.u).max() > 0.3


class Rounded:
    """A linear system whose forces have rounding errors of a part of the loads."""

    def __init__(self, K, f, part, rng):
        self.K, self.f, self.unit, self.rng = K, f, part * np.abs(f).max(), rng

    def net(self, u):
        return self.f - self.K @ u + self.unit * self.rng.uniform(-1, 1, u.shape)

    def linearise(self, u):
        pass

    def product(self, p):
        return self.K @ p

    def precondition(self, r):
        return r


@pytest.mark.parametrize(("part", "converged"), [(1e-14, True), (1e-8, True), (1e-4, False)])
def test_newton_knows_rounding_from_a_lack_of_equilibrium(part, converged, rng):
    A = rng.normal(size=(12, 12))
    system = Rounded(A @ A.T + np.eye(12), rng.normal(size=(12, 1)), part, rng)
    rest = find_rest(system, np.zeros((12, 1)), float(np.linalg.norm(system.f)), 1e-12)
    assert rest.converged == converged
    assert rest.steps < 40 or not converged
    assert rest.residual < 10 * part


def test_conjugate_gradients_find_the_smallest_eigenvalue_and_negative_curvature(rng):
    Q, _ = np.linalg.qr(rng.normal(size=(30, 30)))
    values = np.linspace(0.01, 1.0, 30)
    K, b = (Q * values) @ Q.T, rng.normal(size=30)
    found = conjugate_gradients(lambda p: K @ p, b, lambda r: r, 1e-12, 200)
    np.testing.assert_allclose(found.x, np.linalg.solve(K, b), rtol=1e-8)
    assert found.smallest == pytest.approx(0.01, rel=1e-6)
    values[0] = -0.01
    K = (Q * values) @ Q.T
    assert conjugate_gradients(lambda p: K @ p, b, lambda r: r, 1e-12, 200).negative
    nothing = conjugate_gradients(lambda p: K @ p, 0.0 * b, lambda r: r, 1e-12, 200)
    assert nothing.converged
    assert not nothing.x.any()


# --- paths ------------------------------------------------------------------------------------------------------------


def test_a_path_goes_from_point_to_point():
    model, inputs = cantilever(2)
    points = []
    for factor in (0.0, 0.5, 1.0):
        there = copy.deepcopy(inputs)
        there.fields.force *= factor
        points.append(there)
    path = RestPath(model, points, tolerance=1e-10)
    records = path.run()
    assert path.loose == {}
    assert [point.rest.converged for point in path.points] == [True] * 3
    assert len(records.x) == 4
    alone = Equilibrium(model, inputs)
    np.testing.assert_allclose(records.x[-1].T, alone.record(alone.solve(tolerance=1e-10).u)[:2], rtol=1e-7)
    bar = Records.zeros(3, 2, 2)
    bar.x[:] = 1.0
    gradients = path.gradients(bar)
    rest_shape_bar, _ = alone.gradient(alone.solve(tolerance=1e-10).u, record_bar=bar.to_rows(model.layout.table)[3])
    np.testing.assert_allclose(gradients[2].terms[0][0], rest_shape_bar.terms[0][0], rtol=0, atol=1e-6 * np.abs(
        rest_shape_bar.terms[0][0]).max())  # fmt: skip


@pytest.mark.parametrize("dim", [2, 3])
def test_a_body_that_nothing_holds_is_found(dim):
    model, inputs = cantilever(dim)
    free = [replace(c, nodes=np.zeros_like(c.nodes)) for c in model.conditions]
    assert RestPath(replace(model, conditions=tuple(free)), [inputs]).loose == {"body 0": 3 if dim == 2 else 6}
    # one node that is held leaves the turns about it
    one = [replace(c, nodes=c.nodes & (np.cumsum(c.nodes) == c.nodes.sum() // 2)) for c in model.conditions]
    loose = RestPath(replace(model, conditions=tuple(one)), [inputs]).loose
    assert loose in ({"body 0": 1 if dim == 2 else 3}, {"body 0": 3 if dim == 2 else 6})


def test_a_load_without_an_equilibrium_says_how_far_it_got():
    """A muscle that pushes adds the energy -S |F|^2 / 2: beyond the stiffness of the body, it has no least value."""
    model, inputs = cantilever(2, gravity=0.0)
    kinds = [a.kernel for a in model.actuators]
    inputs.strength[:] = 0.0
    inputs.strength[kinds.index(STRESSES[0])] = 1e6
    inputs.activation[0, kinds.index(STRESSES[0])] = -1.0
    path = RestPath(model, [inputs])
    with np.errstate(all="ignore"):
        path.run()
    (point,) = path.points
    assert not point.rest.converged
    assert point.halvings == 6
    assert 0.0 < point.reached < 0.5


@pytest.mark.parametrize("dim", [2, 3])
def test_a_clamp_that_moves_has_a_gradient_at_rest(dim, rng):
    model, inputs = cantilever(dim)
    turns = 1 if dim == 2 else 3
    spec = Sticky(face="x_min", displacement=[0.0] * dim, rotation=[0.0] * turns, center=[0.2] * dim)
    k = next(k for k, c in enumerate(model.conditions) if c.nodes.any())
    model = replace(
        model, conditions=tuple(replace(c, spec=spec) if j == k else c for j, c in enumerate(model.conditions))
    )
    inputs.moves = np.zeros((len(model.conditions), dim + turns))
    inputs.moves[k] = 0.03 * rng.normal(size=dim + turns)
    equilibrium = Equilibrium(model, inputs)
    rest = equilibrium.solve(tolerance=1e-12)
    assert rest.converged
    bar, _ = equilibrium.gradient(rest.u, record_bar=loss_of(equilibrium, rest.u)[1], tolerance=1e-13)
    for axis in range(dim + turns):
        losses = []
        for sign in (-2, -1, 1, 2):
            there = copy.copy(inputs)
            there.moves = inputs.moves.copy()
            there.moves[k, axis] += sign * 1e-4
            moved = Equilibrium(model, there)
            losses.append(loss_of(moved, moved.solve(rest.u, tolerance=1e-13).u)[0])
        assert bar.moves[k, axis] == pytest.approx(
            (losses[0] - 8 * losses[1] + 8 * losses[2] - losses[3]) / 12e-4, rel=1e-7
        )


def test_a_clamp_that_turns_far_is_followed():
    """By a quarter turn in one step: the free nodes follow to first order, and the way is halved where that fails."""
    model, inputs = cantilever(2, gravity=0.0)
    spec = Sticky(face="x_min", displacement=[0.0, 0.0], rotation=[0.0])
    model = replace(model, conditions=tuple(replace(c, spec=spec) if c.nodes.any() else c for c in model.conditions))
    inputs.strength[:] = 0.0
    inputs.fields.force[:] = 0.0
    inputs.moves = np.zeros((len(model.conditions), 3))
    inputs.moves[:, 2] = np.pi / 2
    path = RestPath(model, [inputs])
    with np.errstate(all="ignore"):
        records = path.run()
    assert path.points[0].rest.converged
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    np.testing.assert_allclose(records.F[1], quarter @ records.F[0], rtol=0, atol=1e-6)


@pytest.mark.parametrize("reverses", [True, False])
def test_a_motion_from_equilibrium_stays_there_and_has_its_gradient(reverses, rng, monkeypatch):
    monkeypatch.setattr("cqrun.engine.statics.settled.TOLERANCE", 1e-13)  # what is left is noise in differences
    model, inputs = cantilever(2, uneven=0.02)
    model = replace(model, settled=True, n_controls=2, substeps=10, dt=2e-3)
    inputs.shaped = True
    inputs.activation = np.repeat(inputs.activation, 2, axis=0)
    still = make_rollout(model, inputs).run()
    np.testing.assert_allclose(still.x[-1], still.x[0], rtol=0, atol=1e-9)
    assert np.abs(still.x[0] - make_rollout(replace(model, settled=False), inputs).run().x[0]).max() > 1e-3
    inputs.activation[1] += 0.05  # and then it moves
    records_bar = Records.zeros(2, 2, 2)
    records_bar.x[:], records_bar.F[:] = rng.normal(size=records_bar.x.shape), rng.normal(size=records_bar.F.shape)
    rollout = make_rollout(model, inputs, adjoint=True)
    rollout.reversible = reverses
    _, bar = rollout.gradient(lambda records, state: LossBar(records_bar))
    for kind in ("E", "force", "activation", "strength", "x"):
        value = PLACES[kind](inputs)
        change = rng.normal(size=value.shape) * (np.abs(value) if kind != "x" else 0.3 * DX)
        ends = []
        for k in (-2, -1, 1, 2):
            there = copy.deepcopy(inputs)
            PLACES[kind](there)[...] += k * 1e-4 * change
            records = make_rollout(model, there).run()
            ends.append((records.x * records_bar.x).sum() + (records.F * records_bar.F).sum())
        difference = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / 12e-4
        assert (PLACES[kind](bar) * change).sum() == pytest.approx(difference, rel=1e-7)


def test_a_motion_of_a_body_that_nothing_holds_has_no_equilibrium_to_start_from():
    model, inputs = cantilever(2)
    free = [replace(c, nodes=np.zeros_like(c.nodes)) for c in model.conditions]
    with pytest.raises(RunError, match="nothing holds body 0"):
        make_rollout(replace(model, conditions=tuple(free), settled=True), inputs)
