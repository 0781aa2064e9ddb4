"""A fixed-free bar in its first axial mode: its frequency, and its decay with viscosity."""

from __future__ import annotations

import numpy as np
import pytest
from bodies import history, lattice, swing
from little_worlds import Wall, below, needs_jit, world

from cqrun.boundaries.slip import Slip
from cqrun.boundaries.sticky import Sticky

pytestmark = needs_jit


def plucked_bar(
    dim: int, dx: float, *, length: float, width: float, E: float, nu: float, eta: float = 0.0, zeta: float = 0.0,
    viscous: bool = True, law: str = "E", v0: float, clamp: type = Sticky, periods: float,
) -> tuple[float, float]:  # fmt: skip
    """Return (angular frequency [rad/s], damping ratio) of a bar along x that starts with v0 sin(pi x / 2 L).

    It is narrow, so that it thins as it lengthens: the field starts so as well, by nu (nu / (1 - nu) in 2D).
    Without `viscous` the viscosities count for the substep only: APIC damps each of them a little.
    """
    x = lattice([0.0] + [4.0] * (dim - 1), [length] + [width] * (dim - 1), dx / 2)
    volume, b1 = (dx / 2) ** dim, np.pi / 2 / length
    c = np.sqrt(E * (1 - nu) / ((1 + nu) * (1 - 2 * nu)))
    z = (4 / 3 * eta + zeta) / (c * dx)
    dt = 0.4 * dx / c * (np.sqrt(1 + z * z) - z)
    guess = b1 * np.sqrt(E / (1 - nu**2 if dim == 2 else 1))
    substeps = max(1, int(2 * np.pi / guess * periods / 200 / dt))
    model, inputs = world(
        x, size=[length + 5] + [8 + width] * (dim - 1), dx=dx, dt=dt, substeps=substeps,
        controls=int(2 * np.pi / guess * periods / (substeps * dt)), mass=volume, volume=volume, nu=nu,
        eta=eta * viscous, zeta=zeta * viscous, walls=[Wall(clamp, tuple(np.eye(dim)[0]), below(0, 0.0))], **{law: E},
    )  # fmt: skip
    mode, s = np.sin(b1 * x[:, 0]), inputs.state
    s.v[:, 0], s.C[:, 0, 0] = v0 * mode, v0 * b1 * np.cos(b1 * x[:, 0])
    for k in range(1, dim):
        s.C[:, k, k] = -(nu / (1 - nu) if dim == 2 else nu) * s.C[:, 0, 0]
        s.v[:, k] = s.C[:, k, k] * (x[:, k] - 4.0 - width / 2)
    time, amplitude = history(model, inputs, lambda s: (s.v[:, 0] * mode).sum() / (mode**2).sum())
    omega, ratio, _ = swing(time, amplitude, guess)
    return omega, ratio


@pytest.mark.parametrize("law", ["E", "neo_hookean"])
def test_its_frequency_converges_with_the_cell(law):
    """L 25 m, E 100 Pa, rho 1 kg/m^3, v0 .1 m/s, nu 0: w = pi / 2 L sqrt(E / rho).

    The error is of first order in dx, as the clamp's place is: -.0152, -.0073, -.0036 at dx 2, 1, .5 m.
    """
    truth = np.pi / 50 * 10
    errors = []
    for dx in (2.0, 1.0, 0.5):
        omega, ratio = plucked_bar(2, dx, length=25.0, width=2.0, E=100.0, nu=0.0, v0=0.1, law=law, periods=2)
        errors.append(omega / truth - 1)
        assert abs(ratio) < 1e-3  # APIC damps little
    assert abs(errors[-1]) < 0.005
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all((orders > 0.85) & (orders < 1.3)), errors


def moduli(dim: int, E: float, nu: float, eta: float, zeta: float, omega: float) -> tuple[float, float]:
    """Return (E', eta_E): the uniaxial modulus and viscosity of a thin bar, in plane strain in 2D.

    A harmonic stress has mu + i w eta for mu and K + i w zeta for K; eta_E is the imaginary part over w.
    """
    mu, K = E / (2 * (1 + nu)) + 1j * omega * eta, E / (3 * (1 - 2 * nu)) + 1j * omega * zeta
    uniaxial = 9 * mu * K / (3 * K + mu)
    if dim == 2:
        uniaxial /= 1 - (uniaxial / (2 * mu) - 1) ** 2
    return uniaxial.real, uniaxial.imag / omega


E, ETA = 100.0, 0.8


@pytest.mark.parametrize(
    ("dim", "nu", "zeta"),
    [(2, 0.0, 2 / 3 * ETA), (2, 0.3, 0.0), (3, 0.3, 0.0), (3, 0.3, 13 / 6 * ETA), (2, 0.45, 0.0), (3, 0.45, 0.0)],
)
def test_viscosity_damps_it_by_eta_w_over_2_E(dim, nu, zeta):
    """zeta = eta_E w / 2 E' to .2 %, the little that APIC damps by itself taken off.

    eta_E runs from 2 eta (nu 0) to 3 eta in 3D and 4 eta in plane strain (incompressible; Trouton's ratios).
    """
    bar = {"length": 10.0, "width": 1.0, "E": E, "nu": nu, "v0": 0.01, "clamp": Slip, "eta": ETA, "zeta": zeta}
    _, numerical = plucked_bar(dim, 0.5, periods=3, viscous=False, **bar)
    omega, ratio = plucked_bar(dim, 0.5, periods=3, **bar)
    modulus, viscosity = moduli(dim, E, nu, ETA, zeta, omega)
    assert omega == pytest.approx(np.pi / 20 * np.sqrt(modulus), rel=0.012)
    assert numerical < 0.05 * ratio
    assert ratio - numerical == pytest.approx(viscosity * omega / (2 * modulus), rel=0.002)
