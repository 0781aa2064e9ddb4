"""What each actuator does to a body: which way it acts, and that it cannot push itself off or turn itself."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from little_worlds import Acting, needs_jit, world
from pydantic import ValidationError

from cqrun.actuators.actuator import Actuator
from cqrun.actuators.body_force import BodyForce
from cqrun.actuators.cable import Cable
from cqrun.actuators.muscle import Muscle
from cqrun.actuators.pneumatic import Pneumatic
from cqrun.engine.frames import make_rollout
from cqrun.state import State

DIM = pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])
DX, DT = 0.1, 2e-3
MUSCLE, CHAMBER = {"body": "b", "strength": 3.0}, {"body": "b", "max_pressure": 3.0}


def run(
    spec: Actuator, particles: np.ndarray, x: np.ndarray, activation: float, *, steps: int = 1,
    start: State | None = None, **options: Any,
) -> State:  # fmt: skip
    """Return the last state of a body at rest at x that flies free, driven by one actuator."""
    act = Acting.of(spec, particles, x)
    model, inputs = world(
        x, size=[1.0] * x.shape[1], dx=DX, substeps=steps, controls=1, actuators=(act,),
        activation=np.full((1, 1), activation), **{"dt": DT, "volume": 0.05 ** x.shape[1]} | options,
    )  # fmt: skip
    inputs.strength[[a.kernel is act.kind for a in model.parts]] = getattr(spec, spec.scale)
    inputs.state = start or inputs.state
    seen: dict[int, State] = {}
    make_rollout(model, inputs).run(observe=seen.__setitem__)
    return seen[1]


# --- momentum -------------------------------------------------------------------------------------------------


def internal(dim: int) -> dict[str, Actuator]:
    """Return every actuator that acts between parts of a body."""
    axis = [1.0, 2.0, -0.5][:dim]
    route = [[0.3, 0.4, 0.5][:dim], [0.5, 0.6, 0.4][:dim], [0.7, 0.3, 0.5][:dim]]
    return {
        "muscle": Muscle(axis=axis, **MUSCLE),
        "muscle_isotropic": Muscle(axis="isotropic", **MUSCLE),
        "pressure": Pneumatic(**CHAMBER),
        "chamber_isotropic": Pneumatic(law="chainqueen", **CHAMBER),
        "chamber_axis": Pneumatic(law="chainqueen", axis=axis, **CHAMBER),
        "cable": Cable(body="b", route=route, stiffness=5.0),
        "tension": Cable(body="b", route=route, tension=2.0),
    }


def momenta(mass: np.ndarray, last: State) -> tuple[float, float]:
    """Return how much linear and angular momentum a body has, each relative to the sum of its parts' sizes.

    A particle's velocity field v + C d has the angular momentum x x m v + (dx^2 / 4) m (C - C^T) in its plane ij.
    """
    dim = last.x.shape[1]
    arm = last.x - last.x.mean(axis=0)
    i, j = np.triu_indices(dim, 1)
    moment = mass[:, None] * (arm[:, i] * last.v[:, j] - arm[:, j] * last.v[:, i])
    own = mass[:, None] * (DX**2 / 4) * (last.C[:, j, i] - last.C[:, i, j])
    p = mass[:, None] * last.v
    linear = np.abs(p.sum(axis=0)).max() / np.abs(p).sum()
    return float(linear), float(np.abs((moment + own).sum(axis=0)).max() / (np.abs(moment) + np.abs(own)).sum())


def crumpled(dim: int, rng: np.random.Generator) -> dict[str, Any]:
    """Return 60 particles anywhere in a box, of various masses and deformed at random."""
    x = 0.3 + 0.4 * rng.random((60, dim))
    start = State.at_rest(x)
    start.F += 0.2 * rng.normal(size=(60, dim, dim))
    return {"x": x, "mass": rng.uniform(1, 3, 60) * 1e-3, "start": start}


@DIM
@pytest.mark.parametrize("name", internal(2))
def test_no_net_force_and_no_net_torque(dim, name, rng):
    spec, body = internal(dim)[name], crumpled(dim, rng)
    particles = spec.particles("", body["x"], lambda body, region: np.arange(60))
    last = run(spec, particles if isinstance(spec, Cable) else particles[::2], activation=0.6, **body)
    assert np.abs(last.v).max() > 1e-3
    linear, angular = momenta(body["mass"], last)
    assert linear <= 1e-12
    assert angular <= 1e-12


@DIM
def test_a_body_force_alone_adds_momentum(dim, rng):
    body = crumpled(dim, rng)
    way = np.array([3.0, 0.0, 4.0][:dim])
    spec = BodyForce(body="b", direction=list(way), acceleration=7.0)
    own = np.arange(0, 60, 2)
    last = run(spec, own, activation=-0.5, **body)
    gained = body["mass"] @ last.v
    want = -0.5 * 7.0 * DT * body["mass"][own].sum() * way / np.linalg.norm(way)
    np.testing.assert_allclose(gained, want, rtol=0, atol=1e-13 * np.abs(want).max())
    assert momenta(body["mass"], last)[0] > 0.1


# --- which way it acts ----------------------------------------------------------------------------------------


def block(dim: int) -> np.ndarray:
    """Return a block of 8 particles a side at rest, .4 m wide."""
    axis = 0.3 + 0.05 * (np.arange(8) + 0.5)
    return np.stack(np.meshgrid(*[axis] * dim, indexing="ij"), -1).reshape(-1, dim)


def growth(spec: Actuator, dim: int, activation: float, **options: Any) -> np.ndarray:
    """Return how much longer a block has grown along each axis, in parts of its width, on the way to rest."""
    x = block(dim)
    settings = {"mass": 0.05**dim, "E": 10.0, "damping": 20.0, "steps": 60} | options
    last = run(spec, np.arange(len(x)), x, activation, **settings)
    return np.ptp(last.x, axis=0) / np.ptp(x, axis=0) - 1.0


@needs_jit
@DIM
def test_a_muscle_contracts_along_its_axis(dim):
    along = Muscle(axis=[0.0] * (dim - 1) + [1.0], **MUSCLE)
    shorter, longer = growth(along, dim, 0.5), growth(along, dim, -0.5)
    assert shorter[-1] < -0.01 < 0.01 < longer[-1]
    # the other axes give way by Poisson's ratio
    assert (longer[:-1] < -0.002).all()
    assert (shorter[:-1] > 0.002).all()
    assert (growth(Muscle(axis="isotropic", **MUSCLE), dim, 0.5) < -0.01).all()


@needs_jit
@DIM
def test_a_chamber_expands(dim):
    assert (growth(Pneumatic(**CHAMBER), dim, 0.5) > 0.01).all()
    assert (growth(Pneumatic(law="chainqueen", **CHAMBER), dim, 0.5) > 0.01).all()
    along = growth(Pneumatic(law="chainqueen", axis=[1.0] + [0.0] * (dim - 1), **CHAMBER), dim, 0.5)
    assert along[0] > 0.01
    assert (along[1:] < -0.002).all()


@needs_jit
@DIM
def test_a_chamber_of_chainqueens_law_is_a_muscle_the_other_way_round(dim):
    axis = [1.0, 2.0, 2.0][:dim]
    chamber = growth(Pneumatic(law="chainqueen", axis=axis, **CHAMBER), dim, 0.5)
    np.testing.assert_array_equal(chamber, growth(Muscle(axis=axis, **MUSCLE), dim, -0.5))


@needs_jit
@DIM
def test_a_hydraulic_chamber_keeps_its_volume(dim):
    """With incompressibility in the material a pressure changes the volume less, the less the stiffer."""
    volumes = [
        np.prod(1.0 + growth(Pneumatic(**CHAMBER), dim, 0.5, incompressible=E, dt=5e-4, steps=240)) - 1.0
        for E in (0.0, 20.0, 200.0)
    ]
    assert 0 < volumes[2] < 0.25 * volumes[1] < 0.25 * volumes[0]


@needs_jit
@DIM
def test_a_cable_pulls_its_ends_together(dim):
    route = [[0.325] + [0.475] * (dim - 1), [0.675] + [0.475] * (dim - 1)]
    spec, x = Cable(body="b", route=route, stiffness=20.0 * 0.05 ** (dim - 2)), block(dim)
    ends = spec.particles("", x, lambda body, region: np.arange(len(x)))
    np.testing.assert_allclose(x[ends], route)
    spans = [
        np.linalg.norm(np.diff(run(spec, ends, x, u, mass=0.05**dim, E=10.0, damping=20.0, steps=60).x[ends], axis=0))
        for u in (1.0, 0.8, 0.5)
    ]
    assert spans[0] == pytest.approx(0.35, abs=1e-12)
    assert spans[2] < spans[1] < 0.345


@needs_jit
@DIM
@pytest.mark.parametrize("u", [1.0, 0.85])
def test_a_cable_never_pushes(dim, u):
    """A body squeezed to .8 of its length: a cable that has more left than that does nothing, to the bit."""
    x = block(dim)
    squeezed = State.at_rest(x)
    squeezed.x[:, 0], squeezed.F[:, 0, 0] = 0.3 + 0.8 * (x[:, 0] - 0.3), 0.8
    ends = np.array([np.argmin(x.sum(axis=1)), np.argmax(x[:, 0] - x[:, 1:].sum(axis=1))])
    route = x[ends].tolist()
    runs = [
        run(Cable(body="b", route=route, stiffness=k), ends, x, u, steps=3, start=squeezed, mass=0.05**dim, E=10.0)
        for k in (0.0, 100.0)
    ]
    for name in ("x", "v", "C", "F"):
        np.testing.assert_array_equal(getattr(runs[1], name), getattr(runs[0], name))
    pulled = run(Cable(body="b", route=route, stiffness=100.0), ends, x, 0.7, steps=3, start=squeezed, mass=0.05**dim,
                 E=10.0)  # fmt: skip
    assert np.abs(pulled.v - runs[0].v).max() > 1e-3


@needs_jit
@DIM
def test_a_tension_pulls_the_same_whatever_the_length(dim):
    """At rest the body carries it as a spring would: twice the tension shortens it twice as much."""
    route = [[0.325] + [0.475] * (dim - 1), [0.675] + [0.475] * (dim - 1)]
    x = block(dim)
    spec = Cable(body="b", route=route, tension={2: 0.05, 3: 0.01}[dim])
    ends = spec.particles("", x, lambda body, region: np.arange(len(x)))
    spans = [
        np.linalg.norm(np.diff(run(spec, ends, x, u, mass=0.05**dim, E=10.0, damping=20.0, steps=60).x[ends], axis=0))
        for u in (0.0, 0.5, 1.0)
    ]
    assert spans[0] == pytest.approx(0.35, abs=1e-12)
    assert spans[0] - spans[1] > 0.002
    assert spans[0] - spans[2] == pytest.approx(2 * (spans[0] - spans[1]), rel=0.05)


def test_a_cable_has_a_stiffness_or_a_tension():
    route = [[0.0, 0.0], [1.0, 0.0]]
    for given, has in (({}, "neither"), ({"stiffness": 1.0, "tension": 1.0}, "both")):
        with pytest.raises(ValidationError, match=f"exactly one of `stiffness` .* and `tension` .*; has {has}"):
            Cable(body="b", route=route, **given)
    assert Cable(body="b", route=route, stiffness=1.0).neutral == 1.0
    assert Cable(body="b", route=route, tension=1.0).neutral == 0.0
