"""What cannot go on stops: it names body, particle and time, on any number of threads, and writes nowhere else."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from little_worlds import needs_jit, world
from rich_scene import ACTUATORS, KINDS, arrays, rich

from cqrun.engine.frames import make_rollout
from cqrun.engine.model import LossBar
from cqrun.engine.setting import MARGIN
from cqrun.errors import RolloutError
from cqrun.state import State

PATIENCE = 240
"""Seconds after which threads that wait for each other have waited for ever (kernels may have to be compiled)."""

HARMLESS = ("damping", "incompressibility.nu", "cable.activation", "cable.rest")
"""What may be infinite: it stops a particle, removes the penalty, slackens the cable."""

THREADS = [1, pytest.param(2, marks=needs_jit)]


def outcome(call: Callable[[], Any]) -> Any:
    """Return what `call` returns or raises; fail where it does neither."""
    found: list[Any] = []

    def body() -> None:
        try:
            with np.errstate(all="ignore"):  # as in compiled kernels
                found.append(call())
        except RolloutError as error:
            found.append(error)

    runner = threading.Thread(target=body, daemon=True)
    runner.start()
    runner.join(PATIENCE)
    assert found, "the rollout neither ended nor raised"
    return found[0]


def thrown(dim: int, direction: np.ndarray, speed: float = 20.0):
    """Return two bodies at rest, and one particle of the second, far from the others, that flies off."""
    first, second = np.full((20, dim), 0.25), np.full((40, dim), 0.3)
    first += 0.1 * np.random.default_rng(0).random(first.shape)
    second += 0.1 * np.random.default_rng(1).random(second.shape)
    second[37] = 0.905  # at the margin's edge between substeps, not at one
    model, inputs = world([first, second], size=[1.2] * dim, dx=0.1, dt=1e-3, substeps=10, controls=10)
    inputs.state.v[20 + 37] = speed * direction
    return model, inputs


@pytest.mark.parametrize("threads", THREADS)
@pytest.mark.parametrize("towards", ["low", "high"])
@pytest.mark.parametrize(("dim", "axis"), [(2, 0), (2, 1), (3, 0), (3, 1), (3, 2)])
def test_a_particle_that_leaves_is_named(dim, axis, towards, threads):
    way = np.eye(dim)[axis] * (1 if towards == "high" else -1)
    model, inputs = thrown(dim, way)
    error = outcome(lambda: make_rollout(model, inputs, threads=threads).run())
    assert isinstance(error, RolloutError)
    assert (error.body, error.particle) == ("body 1", 37)
    # two cells of the margin beyond the world's face, at .02 m a substep
    edge = (model.grid_shape[axis] - 2 - MARGIN) * 0.1 - 0.905 if towards == "high" else 0.905 + 0.2
    assert error.time == pytest.approx(np.ceil(edge / 0.02 - 1e-6) * 1e-3)
    assert "left the grid at" in str(error)
    assert "enlarge the world, add a boundary" in str(error)


@needs_jit
def test_a_gradient_of_such_a_rollout_stops_as_well():
    model, inputs = thrown(2, np.array([1.0, 0.0]))
    error = outcome(
        lambda: make_rollout(model, inputs, threads=2, adjoint=True).gradient(lambda r, s: LossBar(final=s))
    )
    assert isinstance(error, RolloutError)
    assert error.particle == 37


@pytest.mark.parametrize("threads", THREADS)
@pytest.mark.parametrize("speed", [1e3, 1e6, 1e12, 1e300])
def test_at_any_speed_it_stops_before_the_particle_is_scattered_again(speed, threads):
    """A position is written to memory's addresses in the next substep only, and there is none."""
    model, inputs = thrown(3, np.array([1.0, -1.0, 1.0]), speed)
    error = outcome(lambda: make_rollout(model, inputs, threads=threads).run())
    assert isinstance(error, RolloutError)
    assert error.particle == 37
    assert error.time == pytest.approx(1e-3)


@pytest.mark.parametrize("dim", [2, 3])
def test_at_the_very_edge_of_the_grid_transfers_are_right(dim, rng):
    """A particle in each corner, as far out as the guard lets it: its whole stencil is on the grid."""
    shape = world(np.full((1, dim), 0.5), size=[1.0] * dim, dx=0.1, dt=1e-3, substeps=1, controls=1)[0].grid_shape
    low, high = (1 - MARGIN) * 0.1, (np.array(shape) - 2 - MARGIN) * 0.1
    inside = np.array([[(low + 1e-9, h - 1e-9)[k] for k, h in zip(c, high, strict=True)] for c in _corners(dim)])
    model, inputs = world(inside, size=[1.0] * dim, dx=0.1, dt=1e-9, substeps=1, controls=1)
    inputs.state.v[:] = np.sign(0.5 - inside) * rng.random(inside.shape)
    seen: dict[int, State] = {}
    make_rollout(model, inputs).run(observe=seen.__setitem__)
    np.testing.assert_allclose(seen[1].v, inputs.state.v, rtol=0, atol=1e-14)
    for particle, axis in itertools.product(range(2**dim), range(dim)):
        inputs.state.x[:] = inside
        inputs.state.x[particle, axis] += 2e-9 * np.sign(inside[particle, axis] - 0.5)
        with pytest.raises(RolloutError, match=f"particle {particle}, t = 0 s: left the grid"):
            make_rollout(model, inputs)


def _corners(dim: int) -> list[tuple[int, ...]]:
    return list(itertools.product((0, 1), repeat=dim))


@pytest.mark.parametrize("threads", THREADS)
@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("kind", [k for k in KINDS if k not in HARMLESS])
def test_what_is_not_finite_is_found_in_the_first_substeps(kind, bad, threads):
    model, inputs = rich(2)
    array = arrays(inputs)[KINDS.index(kind)]
    # the walls' first coefficient is of the floor; a muscle holds particle 18, the second of the second body
    array[0 if kind.split(".")[0] in ("friction", "spring", *ACTUATORS) else 18] = bad
    error = outcome(lambda: make_rollout(model, inputs, threads=threads).run())
    assert isinstance(error, RolloutError)
    assert error.time <= 2 * model.dt + 1e-12
    assert error.particle < model.layout.counts[int(error.body[-1])]
    if kind in ("x", "mass"):
        assert (error.body, error.particle, error.time) == ("body 1", 1, 0.0)
    assert error.advice


@pytest.mark.parametrize("kind", HARMLESS)
def test_nan_is_found_in_the_others(kind):
    model, inputs = rich(2)
    arrays(inputs)[KINDS.index(kind)][0 if kind.startswith("cable") else 18] = np.nan
    error = outcome(lambda: make_rollout(model, inputs).run())
    assert "its position is not finite; the simulation blew up: use smaller substeps" in str(error)


@pytest.mark.parametrize("threads", THREADS)
def test_a_material_that_blows_up_is_reported_with_its_time(threads):
    """A substep of three times the wave's own blows up some time later, not at once."""
    model, inputs = rich(2, substeps=50, controls=20)
    inputs.terms[0][0][0] *= 3000.0
    error = outcome(lambda: make_rollout(model, inputs, threads=threads).run())
    assert isinstance(error, RolloutError)
    assert model.dt < error.time < 50 * 20 * model.dt
    same = outcome(lambda: make_rollout(model, inputs).run())
    assert str(error) == str(same)


def test_a_rollout_that_is_told_to_stop_ends_between_control_steps():
    model, inputs = rich(2, controls=5)
    seen: list[int] = []
    make_rollout(model, inputs).run(observe=lambda k, state: seen.append(k), should_stop=lambda: len(seen) == 3)
    assert seen == [0, 1, 2]
