"""The finite-element cantilever let go under gravity: what its tip does in time, at finite strains.

The trapezoidal rule (Newmark's average acceleration) has no numerical damping for linear systems. It lengthens a period
by (w dt)^2 / 12, which is 2e-5 with 400 steps a period.
"""

from __future__ import annotations

import numpy as np

from benchmarks.convergence.cantilever import Cantilever
from benchmarks.convergence.equilibrium import CONVERGED, factorised
from benchmarks.convergence.oscillation import Oscillation, fit_oscillation
from cqrun.plugin.contract import Array

STEPS_A_PERIOD = 400


def swing(beam: Cantilever, gravity: float, periods: float) -> Oscillation:
    """Return the swing of the mean height of the end face [m], let go at rest and undeformed.

    Args:
        gravity: along -z [m/s^2].
        periods: length of the fitted window, in periods of the linear frequency.
    """
    frequency = beam.frequency()
    dt = 1.0 / (STEPS_A_PERIOD * frequency)
    count = round(periods * STEPS_A_PERIOD)
    signal = tip_heights(beam, gravity, dt, count)
    return fit_oscillation(dt * np.arange(count + 1), signal, frequency)


def tip_heights(beam: Cantilever, gravity: float, dt: float, count: int) -> Array:
    """Return the mean displacement of the end face along z (count + 1,) [m] at the end of every step."""
    body, material = beam.elements, beam.material
    load = body.body_force(-material.density * gravity * np.eye(beam.dim)[-1])
    consistent = body.mass(material.density)
    M, inertia = beam.held.reduced(consistent), 4.0 / dt**2
    u, v = np.zeros_like(load), np.zeros_like(load)
    a = beam.held.solved(factorised(M), load - body.forces(material, u))
    heights = [0.0]
    for _ in range(count):
        start = u + dt * v + 0.25 * dt**2 * a
        u = u + dt * v + 0.5 * dt**2 * a
        for _ in range(20):
            push = (consistent @ (inertia * (u - start)).ravel()).reshape(u.shape)
            K = beam.held.reduced(body.stiffness(material, u)) + inertia * M
            step = beam.held.solved(factorised(K), load - body.forces(material, u) - push)
            u = u + step
            if np.abs(step).max() <= CONVERGED * np.abs(u).max():
                break
        else:
            raise RuntimeError("a time step does not converge: take a smaller one")
        new = inertia * (u - start)
        v, a = v + 0.5 * dt * (a + new), new
        heights.append(float(beam.end_weights @ u[:, -1]))
    return np.array(heights)
