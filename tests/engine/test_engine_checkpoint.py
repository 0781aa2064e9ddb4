"""Gradients in bounded memory: identical results for any budget, the planned work, and a clear error."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from checkpoint_schedules import Forward, MultistageCheckpointSchedule
from little_worlds import needs_jit, world
from rich_scene import KINDS, arrays, parts, random_records, rich

from cqrun.engine.blocks import SORT_EVERY
from cqrun.engine.checkpoint import borrowed, make_plan, repetitions
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import LossBar, Records
from cqrun.errors import RunError

MODEL = {"substeps": 11, "controls": 9}
"""99 substeps: control steps begin inside chunks, and the last chunk is short."""


@pytest.fixture(scope="module")
def everything_kept():
    """Return a model, its inputs, cotangents of records, and records and gradient with every state kept."""
    model, inputs = rich(2, **MODEL)
    records_bar = random_records(Records.zeros(model.n_controls, 3, 2, model.layout.history), np.random.default_rng(5))
    rollout = make_rollout(model, inputs, adjoint=True)
    records, bar = rollout.gradient(lambda records, state: LossBar(records_bar, state))
    assert rollout.plan.n_chunks == 1
    return model, inputs, records_bar, records, bar


def state_bytes(model) -> int:
    """Return the size of one state as the kernels hold it."""
    return 2 * model.dim * (1 + model.dim) * model.layout.n * 8


@pytest.mark.parametrize("states", [10, 11, 13, 18, 30, 60, 99])
def test_a_gradient_in_little_memory_has_the_same_bits(everything_kept, states):
    model, inputs, records_bar, records, bar = everything_kept
    small = replace(model, memory_budget=states * state_bytes(model) + 8)
    rollout = make_rollout(small, inputs, adjoint=True)
    again, bar_again = rollout.gradient(lambda records, state: LossBar(records_bar, state))
    assert rollout.plan.n_chunks > 1
    assert rollout.plan.states <= states
    for a, b in zip(parts(again), parts(records), strict=True):
        np.testing.assert_array_equal(a, b)
    for kind, a, b in zip(KINDS, arrays(bar_again), arrays(bar), strict=True):
        np.testing.assert_array_equal(a, b, err_msg=kind)


def test_fast_particles_are_sorted_out_of_turn_and_repeat_their_bits_too(everything_kept):
    """At .4 cells a substep particles are sorted every third: a repeated chunk must do so at the same substeps."""
    _, _, records_bar, _, _ = everything_kept
    model, inputs = rich(2, **MODEL)
    inputs.state.v[:] = (10.0, 0.0)
    open_world = replace(model, size=np.array([6.0, 0.9]))
    shape = open_world.grid_shape
    planes = tuple(replace(c, nodes=np.zeros(shape[0] * shape[1], bool)) for c in model.conditions)
    open_world = replace(open_world, conditions=planes)
    found = []
    for states in (12, 100):
        small = replace(open_world, memory_budget=states * state_bytes(model))
        _, bar = make_rollout(small, inputs, adjoint=True).gradient(lambda records, state: LossBar(records_bar, state))
        found.append(bar)
    for kind, a, b in zip(KINDS, *map(arrays, found), strict=True):
        np.testing.assert_array_equal(a, b, err_msg=kind)


@needs_jit
def test_the_budget_is_what_is_used(rng):
    """The peak of NumPy's memory grows with the budget by just that; 600 particles, a state of 57 KiB."""
    x = 0.3 + 0.5 * rng.random((600, 2))
    model, inputs = world(x, size=[1.2, 1.2], dx=0.1, dt=1e-3, substeps=99, controls=1, volume=1e-3, E=10.0)
    peaks, plans = [], []
    for states in (12, 12, 92):  # the first one compiles
        fresh = replace(model, memory_budget=states * state_bytes(model), spare=[])
        rollout = make_rollout(fresh, inputs, adjoint=True)
        tracemalloc.start()
        rollout.gradient(lambda records, state: LossBar(final=state))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        plans.append(rollout.plan.states)
    assert plans[2] > 50 > 12 >= plans[1]
    assert peaks[2] - peaks[1] == pytest.approx((plans[2] - plans[1]) * state_bytes(model), rel=0.05)


def test_memory_is_used_again():
    """The same bytes, as long as they suffice; given back where the work fails, too; two at once have two."""
    spare = []
    with borrowed(spare, (3, 4), np.float64) as first:
        assert first.shape == (3, 4)
        address = first.ctypes.data
    with borrowed(spare, (6,), np.float32) as second, borrowed(spare, (2,), np.float64) as third:
        assert second.ctypes.data == address
        assert third.ctypes.data != address
    assert len(spare) == 2
    with pytest.raises(ValueError, match="no"), borrowed(spare, (100,), np.float64):
        raise ValueError("no")
    assert sorted(held.nbytes for held in spare)[-1] == 800


def test_two_threads_may_reach_for_the_same_memory():
    """One that was asked for while there still was some, as another thread took it."""

    class Taken(list):
        def __bool__(self) -> bool:
            return True

    with borrowed(Taken(), (3, 4), np.float64) as own:
        assert own.shape == (3, 4)


@pytest.mark.parametrize("snapshots", [1, 2, 3, 5, 8])
@pytest.mark.parametrize("n", [1, 2, 3, 4, 7, 12, 31, 60])
def test_the_promised_work_is_that_of_the_schedule(n, snapshots):
    snapshots = min(snapshots, n - 1)
    if n == 1:
        assert repetitions(n, 1) == 1
        return
    advances = sum(a.n1 - a.n0 for a in MultistageCheckpointSchedule(n, snapshots, 0) if isinstance(a, Forward))
    assert repetitions(n, snapshots) == advances


@pytest.mark.parametrize(("n_steps", "states"), [(1, 2), (8, 9), (99, 10), (1000, 40), (10_000, 174), (10_000, 10)])
def test_a_plan_stays_in_its_budget_and_covers_every_substep(n_steps, states):
    plan = make_plan(n_steps, 1000, 1000 * states + 999)
    assert plan.states <= states
    assert plan.states == plan.snapshots + plan.chunk + 1
    assert (plan.n_chunks - 1) * plan.chunk < n_steps <= plan.n_chunks * plan.chunk
    assert plan.n_chunks == 1 or plan.chunk % SORT_EVERY == 0
    if (n_steps, states) == (10_000, 174):
        assert plan.recompute < 3.5  # 2 GiB for 64,000 particles in 3D


def test_too_small_a_budget_is_refused_with_the_one_that_would_do():
    model, inputs = rich(2, **MODEL)
    need = (SORT_EVERY + 2) * state_bytes(model)
    tight = replace(model, memory_budget=need - 1)
    with pytest.raises(RunError, match=r"set `memory: (\d+)MiB` or more, or use fewer particles") as caught:
        make_rollout(tight, inputs, adjoint=True).gradient(lambda records, state: LossBar(final=state))
    advised = int(str(caught.value).split("memory: ")[1].split("MiB")[0]) * 2**20
    enough = replace(model, memory_budget=advised)
    make_rollout(enough, inputs, adjoint=True).gradient(lambda records, state: LossBar(final=state))
