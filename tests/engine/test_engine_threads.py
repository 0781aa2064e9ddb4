"""What a result must not depend on: the number of threads, other bodies far away, padding; and float32."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from little_worlds import Acting, Wall, below, needs_jit, world
from rich_scene import KINDS, arrays, parts, product, random_records, rebuilt, rich

from cqrun.actuators import body_force, cable
from cqrun.boundaries.friction import Friction
from cqrun.build.model import build
from cqrun.engine import forward_run
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import LossBar, Records
from cqrun.forces import spring
from cqrun.scene.load import load_scene
from cqrun.state import Layout, State

SCENES = Path(__file__).parents[2] / "scenes"


def gradient(model, inputs, threads, records_bar):
    """Return the last state, the records and the gradient on so many threads."""
    last: list[State] = []

    def loss_bar(records, state):
        last.append(state)
        return LossBar(records_bar, state)

    records, bar = make_rollout(model, inputs, threads=threads, adjoint=True).gradient(loss_bar)
    return last[0], records, bar


def crowd(dim: int, rng: np.random.Generator):
    """Return 600 particles of two bodies that fly apart over many blocks, onto walls with friction."""
    x = 0.35 + 0.7 * rng.random((600, dim))
    up, routes = tuple(np.eye(dim)[-1]), [np.arange(7, 600, 97), np.array([3, 260, 400]), np.array([8, 104, 300])]
    model, inputs = world(
        [x[:250], x[250:]], size=[1.4] * dim, dx=0.05, dt=4e-3, substeps=10, controls=4, mass=rng.uniform(1, 2, 600),
        volume=1.0, E=2.0, neo_hookean=0.5, eta=0.01, damping=0.1, gravity=[0.0] * (dim - 1) + [-1.0],
        walls=[Wall(Friction, up, below(dim - 1, 0.3), 0.3)], probe=rng.random((2, 600)),
        muscles=((np.arange(0, 600, 3), np.eye(dim)),), activation=0.1 * rng.random((4, 4)),
        actuators=(*(Acting(cable.CableKernel, r, np.zeros(0), 0.1) for r in routes[:2]),
                   Acting(body_force.BodyForceKernel, np.arange(0, 600, 5), np.eye(dim)[0])),
        springs=(Acting(spring.SpringKernel, routes[2], np.zeros(0), 0.1),),
    )  # fmt: skip
    inputs.strength[2:] = 0.02
    # faces of blocks lie every .2 m: particles cross some, and are sorted before their turn
    inputs.state.v[:] = 2.0 * (x - 0.7) + 0.3 * rng.normal(size=x.shape)
    return model, inputs


@needs_jit
@pytest.mark.parametrize("dim", [2, 3])
def test_one_thread_and_two_and_three_give_the_same_bits(dim, rng):
    model, inputs = crowd(dim, rng)
    records_bar = random_records(Records.zeros(model.n_controls, 2, dim, model.layout.history), rng)
    state, records, bar = gradient(model, inputs, 1, records_bar)
    moved = np.floor(state.x / 0.2) != np.floor(inputs.state.x / 0.2)
    assert moved.any(axis=1).mean() > 0.2
    for threads in (2, 3):
        others = gradient(model, inputs, threads, records_bar)
        for a, b in zip(parts(others[0]), parts(state), strict=True):
            np.testing.assert_array_equal(a, b)
        for a, b in zip(parts(others[1]), parts(records), strict=True):
            np.testing.assert_array_equal(a, b)
        for kind, a, b in zip(KINDS, arrays(others[2]), arrays(bar), strict=True):
            np.testing.assert_array_equal(a, b, err_msg=kind)


@needs_jit
@pytest.mark.parametrize("real", [np.float64, np.float32])
@pytest.mark.parametrize("dim", [2, 3])
def test_substeps_one_by_one_and_tile_by_tile_give_the_same_bits(dim, real, rng, monkeypatch):
    """With all states kept, on two threads, and in little memory."""
    model, inputs = crowd(dim, rng)
    model = replace(model, real=real)
    records_bar = random_records(Records.zeros(model.n_controls, 2, dim, model.layout.history), rng)
    short = replace(model, memory_budget=20 * 2 * dim * (1 + dim) * model.layout.n * np.dtype(real).itemsize)
    state, records, bar = gradient(model, inputs, 1, records_bar)
    monkeypatch.setattr("cqrun.engine.updated.rollout.CHAINED_FROM", 0)
    for other, threads in ((model, 1), (model, 2), (short, 1)):
        again, records_again, bar_again = gradient(other, inputs, threads, records_bar)
        for a, b in zip((*parts(again), *parts(records_again)), (*parts(state), *parts(records)), strict=True):
            np.testing.assert_array_equal(a, b)
        for kind, a, b in zip(KINDS, arrays(bar_again), arrays(bar), strict=True):
            np.testing.assert_array_equal(a, b, err_msg=kind)


@needs_jit
def test_large_bodies_are_chained_whether_or_not_forces_pull_them(monkeypatch):
    found = {}
    for name in ("simulate/oscillator", "control/biped_cable"):
        built = build(load_scene(SCENES / f"{name}.yaml", []))
        inputs = built.assembly.inputs({})
        size = make_rollout(built.model, inputs).start.nbytes
        for least in (size, size + 1):
            monkeypatch.setattr("cqrun.engine.updated.rollout.CHAINED_FROM", least)
            found[name, least - size] = make_rollout(built.model, inputs).setting.chained
    assert list(found.values()) == [True, False, True, False]


@needs_jit
def test_more_threads_than_work(rng):
    """One lane of particles, four threads: three of them wait."""
    model, inputs = rich(2)
    records_bar = random_records(Records.zeros(model.n_controls, 3, 2, model.layout.history), rng)
    bars = [gradient(model, inputs, threads, records_bar)[2] for threads in (1, 4)]
    for kind, a, b in zip(KINDS, *map(arrays, bars), strict=True):
        np.testing.assert_array_equal(a, b, err_msg=kind)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_body_far_away_changes_no_bit(dim, rng):
    """A body of 17 particles, padded to 32, moves the same alone and before or after another one."""
    near, far = 0.3 + 0.3 * rng.random((17, dim)), 1.5 + 0.3 * rng.random((23, dim))
    v = {17: rng.normal(size=(17, dim)), 23: rng.normal(size=(23, dim))}
    modulus = {17: rng.uniform(1, 2, 17), 23: rng.uniform(1, 2, 23)}
    found = []
    for bodies in ([near], [near, far], [far, near]):
        sizes = [len(b) for b in bodies]
        model, inputs = world(
            bodies, size=[2.4] * dim, dx=0.1, dt=5e-3, substeps=10, controls=1, mass=1.0, volume=1.0,
            E=np.concatenate([modulus[n] for n in sizes]), eta=0.01,
        )  # fmt: skip
        inputs.state.v[:] = np.concatenate([v[n] for n in sizes])
        own = model.layout.slices()[sizes.index(17)]
        last, _, bar = gradient(model, inputs, 1, None)
        found.append([a[own] for a in parts(last)] + [a[own] for a in parts(bar.state)] + [bar.terms[0][0][:, own]])
    for other in found[1:]:
        for a, b in zip(other, found[0], strict=True):
            np.testing.assert_array_equal(a, b)


def test_padding_copies_the_last_particle_and_has_no_mass():
    layout = Layout(2, (17, 16))
    assert (layout.padded, layout.n) == ((32, 16), 48)
    np.testing.assert_array_equal(layout.sources()[16:32], 16)
    np.testing.assert_array_equal(layout.columns(), [*range(17), *range(32, 48)])
    np.testing.assert_array_equal(np.flatnonzero(~layout.real()), np.arange(17, 32))
    state = State.at_rest(np.arange(66.0).reshape(33, 2))
    again = State.unpack(state.pack(layout), layout, state.memory)
    for a, b in zip(parts(again), parts(state), strict=True):
        np.testing.assert_array_equal(a, b)


@needs_jit
@pytest.mark.parametrize("dim", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_float32_is_close_to_float64(dim, rng):
    model, inputs = rich(dim)
    records_bar = random_records(Records.zeros(model.n_controls, 3, dim, model.layout.history), rng)
    _, records, bar = gradient(model, inputs, 1, records_bar)
    _, records_32, bar_32 = gradient(replace(model, real=np.float32), inputs, 1, records_bar)
    assert 0 < product(_difference(records_32, records), _difference(records_32, records)) < 1e-11
    for kind, a, b in zip(KINDS, arrays(bar_32), arrays(bar), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=2e-5 * np.abs(b).max(), err_msg=kind)


def _difference(a: Records, b: Records) -> Records:
    return rebuilt(a, [p - q for p, q in zip(parts(a), parts(b), strict=True)])


@needs_jit
@pytest.mark.parametrize(
    ("worth", "call_worth", "threads"), [(1000, 1, 1), (300, 1, 2), (1, 1, 4), (1, 2000, 3), (1, 7000, 1)]
)
def test_threads_with_too_little_to_do_stay_away(worth, call_worth, threads, rng, monkeypatch):
    model, inputs = crowd(2, rng)  # 600 particles, 10 substeps in a control step
    monkeypatch.setattr(forward_run, "THREAD_WORTH", worth)
    monkeypatch.setattr(forward_run, "CALL_WORTH", call_worth)
    assert make_rollout(model, inputs, threads=4).threads == threads
    assert make_rollout(model, inputs).threads == 1
