"""Every registered observer: its adjoint checked by complex step, alone and together with the others."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from made_encoders import made_encoder
from made_matter import CONTROL_STEP, N_ACTUATORS, box_around_left, made_matter, mismatch, moved, slope

from cqrun.observers.observer import BY_NAME, BoundObserver, Moment, MomentBar, Observation
from cqrun.observers.pca import Pca, fit_components
from cqrun.observers.vae import Vae
from cqrun.plugin.registry import plugins
from cqrun.state import State

ALL = ["position", "velocity", "acceleration"]


def examples(dim: int) -> dict[str, list[dict[str, Any]]]:
    """Return fields for each plug-in to test."""
    return {
        "centroids": [
            {"body": "arm", "of": ["acceleration", "position"]},
            {"body": "arm", "groups": ["tip"], "of": ALL, "range": None},
            {"body": "ball", "range": {"position": [[0, 1], [0, 2], [0, 3]][:dim], "velocity": None}},
        ],
        "clusters": [{"body": "arm", "count": 3}, {"body": "arm", "count": 2, "of": ALL}],
        "strain": [
            {"body": "arm"},
            {"body": "arm", "region": box_around_left(dim), "range": [-0.2, 0.3]},
            {"body": "arm", "axis": [1.0, 2.0, -1.0][:dim]},
        ],
        "clock": [{}, {"period": 0.3, "harmonics": 2}],
        "goal": [{"goal": "target", "body": "arm"}, {"goal": "target", "body": "arm", "group": "tip"},
                 {"goal": "target"}],
        "measured": [
            {"quantity": "tip"}, {"quantity": "gap", "range": [0.0, 0.5]},
            *({"quantity": name} for name in ("slips", "spins", "held", "twists", "cable", "pulls", "blows")),
        ],
        "pca": [{"body": "arm", "components": 2}],
        "vae": [{"body": "arm", "file": "made by `make`"}],
    }  # fmt: skip


CASES = [(name, k) for name, tried in examples(2).items() for k in range(len(tried))]
EVERY = pytest.mark.parametrize(("name", "k"), CASES, ids=[f"{name}{k}" for name, k in CASES])
DIM = pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])


def make(name: str, k: int, dim: int, rng: np.random.Generator) -> BoundObserver:
    spec, matter = plugins("observer")[name].model_validate(examples(dim)[name][k]), made_matter(dim)
    if isinstance(spec, Pca):
        x = matter.x[matter.members("arm")] + 0.1 * rng.normal(size=(5, len(matter.members("arm")), dim))
        return spec.bind_to(matter, fit_components(x, 3))
    if isinstance(spec, Vae):
        return spec.bind_to(matter, made_encoder(dim, rng))
    return spec.bind(matter)


def a_moment(bound: BoundObserver, dim: int, rng: np.random.Generator, control: int = 3) -> Moment:
    k, n = bound.rows.shape
    draw = lambda *shape: rng.normal(size=(k, *shape))  # noqa: E731
    drawn = lambda *shape: rng.normal(size=(n, *shape))  # noqa: E731
    state = State(0.3 * drawn(dim), drawn(dim), drawn(dim, dim), drawn(dim, dim))
    return Moment(
        draw(dim), draw(dim), draw(dim, dim), np.eye(dim) + 0.3 * draw(dim, dim), CONTROL_STEP * control, control,
        {"target": rng.normal(size=dim)}, rng.normal(size=bound.n_memory), lambda: state,
        {name: rng.normal(size=6 if dim == 2 else 12) for name in ("stone", "jaw")},
        {name: rng.normal(size=3 if dim == 2 else 6) for name in ("clamp", "floor")},
        0.2 + rng.uniform(size=N_ACTUATORS), 2.0 + rng.uniform(size=N_ACTUATORS + 1),
        0.5 + 0.2 * rng.uniform(size=N_ACTUATORS + 1), rng.uniform(size=N_ACTUATORS + 1),
    )  # fmt: skip


def adjoint_error(bound: BoundObserver, moment: Moment, rng: np.random.Generator) -> float:
    """Return the relative error of bar . (J d) = (J^T bar) . d."""
    z, memory = bound.observe(moment)
    z_bar, memory_bar = rng.normal(size=z.shape), rng.normal(size=memory.shape)
    names = ("x", "v", "C", "F", "memory", "activation", "strength", "rest_length", "friction")
    directions: dict[str, Any] = {name: rng.normal(size=getattr(moment, name).shape) for name in names}
    for kind in BY_NAME:
        directions[kind] = {name: rng.normal(size=row.shape) for name, row in getattr(moment, kind).items()}
    state, pushes = moment.state(), {name: rng.normal(size=getattr(moment.state(), name).shape) for name in "xvCF"}
    tilted = replace(moment, **{name: moved(getattr(moment, name), directions[name]) for name in directions})
    tilted.state = lambda: State(*(moved(getattr(state, name), push) for name, push in pushes.items()))
    expected = slope(lambda: np.concatenate(bound.observe(tilted)), np.concatenate([z_bar, memory_bar]))
    bar = bound.observe_vjp(moment, z_bar, memory_bar)
    parts = [bar_of(bar, name, directions[name].shape) * directions[name] for name in names]
    for kind in BY_NAME:
        parts += [part * directions[kind][name] for name, part in (getattr(bar, kind) or {}).items()]
    if bar.state is not None:
        parts += [bar_of(bar.state, name, push.shape) * push for name, push in pushes.items()]
    return mismatch(sum(float(p.sum()) for p in parts), expected, sum(float(np.abs(p).sum()) for p in parts))


def bar_of(bar: MomentBar | State, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return a cotangent, None as zeros; fail if its shape is not that of its value."""
    part = getattr(bar, name)
    assert part is None or part.shape == shape, name
    return np.zeros(shape) if part is None else part


def test_every_observer_has_an_example():
    assert set(examples(2)) == set(plugins("observer"))


@EVERY
@DIM
@pytest.mark.parametrize("control", [0, 3])
def test_dot_product(name, k, dim, control, rng):
    bound = make(name, k, dim, rng)
    assert adjoint_error(bound, a_moment(bound, dim, rng, control), rng) <= 1e-9


@EVERY
@DIM
def test_shapes(name, k, dim, rng):
    bound = make(name, k, dim, rng)
    z, memory = bound.observe(a_moment(bound, dim, rng))
    assert z.shape == bound.low.shape == bound.high.shape == (bound.size,)
    assert memory.shape == (bound.n_memory,)
    assert bound.rows.shape[1] == made_matter(dim).n_particles
    assert (bound.low < bound.high).all()
    assert bound.needs_state == (name == "vae")


def test_a_wrong_adjoint_fails(rng):
    bound = make("strain", 0, 2, rng)
    right = bound.observe_vjp
    bound.observe_vjp = lambda *args: MomentBar(F=1.001 * right(*args).F)  # type: ignore[method-assign]
    assert adjoint_error(bound, a_moment(bound, 2, rng), rng) > 1e-4


@DIM
@pytest.mark.parametrize("control", [0, 3])
def test_all_observers_together(dim, control, rng):
    bound = {f"{name}{k}": make(name, k, dim, rng) for name, k in CASES}
    observation = Observation(bound, made_matter(dim).n_particles)
    moment = a_moment(observation, dim, rng, control)
    assert observation.size == sum(o.size for o in bound.values())
    assert adjoint_error(observation, moment, rng) <= 1e-9
    z, _ = observation.observe(moment)
    row = n_memory = 0
    for name, single in bound.items():
        rows, memory = slice(row, row + single.rows.shape[0]), slice(n_memory, n_memory + single.n_memory)
        row, n_memory = rows.stop, memory.stop
        share = replace(moment, x=moment.x[rows], v=moment.v[rows], C=moment.C[rows], F=moment.F[rows],
                        memory=moment.memory[memory])  # fmt: skip
        alone, _ = single.observe(share)
        scaled = 2 * (alone - single.low) / (single.high - single.low) - 1
        np.testing.assert_allclose(z[observation.parts[name]], scaled, rtol=1e-12, atol=1e-12)
        assert (observation.rows[rows] != single.rows).nnz == 0


class _OfState(BoundObserver):
    """An observer that reads all particles."""

    size, needs_state = 1, True
    low, high = np.full(1, -1.0), np.full(1, 1.0)

    def __init__(self, rows: Any) -> None:
        self.rows = rows

    def observe(self, moment: Moment) -> tuple[np.ndarray, np.ndarray]:
        return np.array([np.sum(moment.state().x ** 2)]), np.zeros(0)

    def observe_vjp(self, moment: Moment, z_bar: np.ndarray, memory_next_bar: np.ndarray) -> MomentBar:
        state = moment.state()
        zeros = State(*(np.zeros_like(a) for a in (state.x, state.v, state.C, state.F)), np.zeros(0))
        return MomentBar(state=replace(zeros, x=2 * z_bar[0] * state.x))


def test_cotangents_of_observers_of_all_particles_add_up(rng):
    empty = make("clock", 0, 2, rng)
    observation = Observation({"a": _OfState(empty.rows), "clock": empty, "b": _OfState(empty.rows)}, 3)
    assert observation.needs_state
    x = rng.normal(size=(3, 2))
    moment = replace(a_moment(observation, 2, rng), state=lambda: State.at_rest(x))
    z, _ = observation.observe(moment)
    assert z[0] == z[2] == pytest.approx(np.sum(x**2))
    bar = observation.observe_vjp(moment, np.array([1.0, 5.0, 2.0]), np.zeros(0))
    np.testing.assert_allclose(bar.state.x, 6 * x)
    assert bar.x is None
    assert bar.state.F.shape == (3, 2, 2)


def test_no_observer_at_all(rng):
    observation = Observation({}, 7)
    assert observation.size == 0
    assert observation.rows.shape == (0, 7)
    moment = a_moment(observation, 2, rng)
    assert [a.shape for a in observation.observe(moment)] == [(0,), (0,)]
    assert observation.observe_vjp(moment, np.zeros(0), np.zeros(0)) == MomentBar()


def test_a_cable_that_rubs_is_seen_with_its_friction(rng):
    """By a difference, because the angles of a route are not exact for complex numbers."""
    bound = plugins("observer")["measured"](quantity="rubs").bind(made_matter(2))
    moment, h = a_moment(bound, 2, rng), 1e-6
    bar = bound.observe_vjp(moment, np.ones(1), np.zeros(0))
    for name in ("strength", "friction", "activation"):
        value = getattr(moment, name)
        ends = [bound.observe(replace(moment, **{name: value + sign * h}))[0].sum() for sign in (-1, 1)]
        assert getattr(bar, name).sum() == pytest.approx((ends[1] - ends[0]) / (2 * h), rel=1e-7)
        assert abs(getattr(bar, name).sum()) > 1e-3
