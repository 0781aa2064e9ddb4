"""Numbers of the reference frame that follow from its equations alone, in 2D and 3D."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bodies import history, lattice, swing
from little_worlds import Wall, below, needs_jit, world

from cqrun.boundaries.sticky import Sticky
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import Inputs, Model
from cqrun.engine.reference.patches import count_nodes

pytestmark = needs_jit

E, LENGTH, DX = 100.0, 10.0, 0.5
WAVE = np.sqrt(E)
OMEGA = np.pi / 2 / LENGTH * WAVE


def in_reference(model: Model, inputs: Inputs) -> Model:
    """Return a model in the reference frame."""
    return replace(model, frame="reference", n_nodes=count_nodes(model.layout, inputs.state.x, model.dx))


def bar(dim: int, *, eta: float = 0.0, finer: int = 1, periods: float = 6.0) -> tuple[float, float]:
    """Return (angular frequency [rad/s], damping ratio) of a fixed-free bar that starts with v0 sin(pi x / 2 L).

    With nu = 0 and zeta = 2/3 eta, stress is E times strain and 2 eta times its rate, along the bar alone: the mode is
    exact, of the frequency pi / 2 L sqrt(E / rho) and the damping ratio eta w / E.
    """
    x = lattice([0.0] + [4.0] * (dim - 1), [LENGTH] + [2 * DX] * (dim - 1), DX / 2)
    volume, substeps = (DX / 2) ** dim, 16
    model, inputs = world(
        x, size=[LENGTH + 5] + [8 + 2 * DX] * (dim - 1), dx=DX, dt=2 * np.pi / OMEGA / 40 / substeps / finer,
        substeps=substeps * finer, controls=round(40 * periods), mass=volume, volume=volume, E=E, nu=0.0, eta=eta,
        zeta=2 / 3 * eta, walls=[Wall(Sticky, (1.0,) + (0.0,) * (dim - 1), below(0, 0.0))],
    )  # fmt: skip
    assert model.dt < 0.3 * DX / WAVE
    mode = np.sin(np.pi / 2 / LENGTH * x[:, 0])
    inputs.state.v[:, 0] = 1e-3 * mode
    time, amplitude = history(in_reference(model, inputs), inputs, lambda s: float((s.v[:, 0] * mode).sum()))
    return swing(time, amplitude, OMEGA)[:2]


@pytest.mark.parametrize("dim", [2, 3])
def test_there_is_no_numerical_damping_and_the_substep_does_not_matter(dim):
    found = [bar(dim, finer=finer) for finer in (1, 4, 16)]
    frequencies, ratios = np.array(found).T
    assert np.abs(ratios).max() < 2e-5
    assert np.ptp(frequencies) < 1e-4 * OMEGA
    np.testing.assert_allclose(frequencies, OMEGA, rtol=0.012)  # of first order in dx: the free end is lumped


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("ratio", [0.00053, 0.02])
def test_a_viscosity_comes_out_as_it_is(dim, ratio):
    omega, found = bar(dim, eta=ratio * E / OMEGA)
    assert found == pytest.approx(ratio * omega / OMEGA, rel=5e-3)


def block(dim: int) -> tuple[Model, Inputs]:
    """Return a free block of 2 cells that turns once in 2 seconds, a hundred times, and wobbles."""
    x = lattice([2.0] * dim, [1.0] * dim, 0.25)
    volume, rate = 0.25**dim, np.pi
    spin = np.zeros((dim, dim))
    spin[0, 1], spin[1, 0] = -rate, rate
    model, inputs = world(
        x, size=[5.0] * dim, dx=DX, dt=0.01, substeps=200, controls=100, mass=volume, volume=volume, E=500.0, nu=0.3,
    )  # fmt: skip
    inputs.state.C[:] = spin
    inputs.state.v[:] = (x - x.mean(axis=0)) @ spin.T
    inputs.state.v[:, -1] += 0.05 * (x[:, 0] - x[:, 0].mean())
    return in_reference(model, inputs), inputs


@pytest.mark.parametrize("dim", [2, 3])
def test_a_hundred_turns_keep_the_angular_momentum(dim):
    model, inputs = block(dim)
    rollout = make_rollout(model, inputs)
    X, m = rollout.rest.patches.positions(model.dx), rollout.bundle.nodes.mass[:, None]
    states, momenta = rollout.start[None].copy(), []
    for k in range(model.n_controls + 1):
        moment = (m * (X + states[0, 0, :, :dim])).T @ states[0, 1, :, :dim]
        momenta.append(moment - moment.T)
        if k < model.n_controls:
            rollout.advance(k * model.substeps, (k + 1) * model.substeps, states, keep=False)
    assert np.abs(np.array(momenta) - momenta[0]).max() < 1e-11 * np.abs(momenta[0]).max()
