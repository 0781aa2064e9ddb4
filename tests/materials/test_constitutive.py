"""Every term of a stress that the registry knows: its adjoint, and what its physics demands of it."""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import numpy as np
import pytest
from constitutive import (
    N,
    Term,
    adjoint_errors,
    all_names,
    elastic_names,
    entries,
    make,
    matrices,
    of_class,
    richardson,
    rotations,
    states,
    t,
)

from cqrun.materials import term
from cqrun.materials.incompressibility import Incompressibility, bulk_modulus
from cqrun.materials.lame import lame, lame_vjp
from cqrun.materials.stress import total_kirchhoff, total_kirchhoff_vjp
from cqrun.materials.term import MaterialTerm, kirchhoff, kirchhoff_vjp
from cqrun.numerics.compile import kernel
from cqrun.numerics.lanes import lane_width
from cqrun.numerics.packed import load, pack, store, unpack
from cqrun.numerics.polar import polar
from cqrun.numerics.symmetric import from_rows, symmetric_rows

DIM = pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])
EVERY = pytest.mark.parametrize("name", all_names())
ELASTIC = pytest.mark.parametrize("name", elastic_names())
HYPERELASTIC = pytest.mark.parametrize("name", [*elastic_names(), "incompressibility", "incompressibility^4"])

DOT_PRODUCT = 1e-9


def close(got: np.ndarray, want: np.ndarray, tolerance: float = 1e-12) -> None:
    """Assert that arrays agree to a tolerance relative to the largest entry."""
    np.testing.assert_allclose(got, want, rtol=0, atol=tolerance * max(np.abs(want).max(), 1e-3))


# --- adjoints --------------------------------------------------------------------------------------------


@EVERY
@DIM
def test_dot_product(name, dim, rng):
    for argument, error in adjoint_errors(make(name, dim, rng), dim, rng):
        assert error <= DOT_PRODUCT, argument


class _Strange(NamedTuple):
    """A kernel class that nobody registered."""

    theta: Any
    rows: tuple[int, ...]


class _Forgetful(MaterialTerm):
    """A law whose author forgot the adjoint, or has it wrong."""

    parameters: ClassVar[tuple[str, ...]] = ("youngs_modulus",)

    def kernel_term(self, theta: Any) -> Any:
        return _Strange(theta, (0,))


def _stress(term: Any, theta: Any, F: Any, C: Any) -> Any:
    return tuple(theta[0] * entry for entry in F)


def test_a_law_without_an_adjoint_fails_the_generated_test(rng, monkeypatch):
    term = of_class("forgetful", _Forgetful, rng)
    with pytest.raises(KeyError):
        list(adjoint_errors(term, 2, rng))
    monkeypatch.setitem(*_registered(0, _stress))
    with pytest.raises(KeyError):
        list(adjoint_errors(term, 2, rng))


def test_a_law_with_a_wrong_adjoint_fails_the_generated_test(rng, monkeypatch):
    def wrong(term: Any, theta: Any, F: Any, C: Any, tau_bar: Any) -> Any:
        return (0.0,), tuple(theta[0] * b for b in tau_bar), tuple(0.0 * c for c in C)

    for k, function in enumerate((_stress, wrong)):
        monkeypatch.setitem(*_registered(k, function))
    errors = dict(adjoint_errors(of_class("forgetful", _Forgetful, rng), 2, rng))
    assert errors["theta"] > 0.1
    assert errors["F"] <= DOT_PRODUCT


def _registered(which: int, function: Any) -> tuple[dict[type, Any], type, Any]:
    """Return what registers a function as the stress, or as its adjoint, of the strange law."""
    table, arguments = ((term._STRESS, "term, theta, F, C"), (term._STRESS_VJP, "term, theta, F, C, tau_bar"))[which]
    return table.bodies, _Strange, (function, arguments)


# --- physics of every term -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [n for n in all_names() if n != "muscle"])
@DIM
def test_a_body_that_is_only_turned_has_no_stress(name, dim, rng):
    term = make(name, dim, rng)
    tau = term.tau(rotations(dim, rng), np.zeros((N, dim, dim)))
    np.testing.assert_allclose(tau, 0.0, rtol=0, atol=1e-14 + 3e-15 * term.spec.wave_modulus(term.theta).max())


@EVERY
@DIM
def test_objectivity(name, dim, rng):
    """tau(Q F, Q C Q^T + any spin) = Q tau Q^T."""
    term, (F, C), Q = make(name, dim, rng), states(dim, rng), rotations(dim, rng)
    spin = rng.normal(size=(N, dim, dim))
    close(term.tau(Q @ F, Q @ C @ t(Q) + spin - t(spin)), Q @ term.tau(F, C) @ t(Q))


@EVERY
@DIM
def test_no_stress_turns_a_particle(name, dim, rng):
    term = make(name, dim, rng)
    tau = term.tau(*states(dim, rng))
    close(tau, t(tau))


@pytest.mark.parametrize("name", [n for n in all_names() if n != "fibre:2"])  # its directions leave the plane in 3D
def test_two_dimensions_are_plane_strain(name, rng):
    """In 3D with F_zz = 1 and C_zz = 0 the stress in the plane is that of 2D."""
    flat, solid = make(name, 2, rng), make(name, 3, rng)
    theta = flat.theta
    if name == "muscle":  # rows xx yy xy, of xx yy zz xy xz yz
        theta = np.zeros((6, N))
        theta[[0, 1, 3]] = flat.theta
    F, C = states(2, rng)
    F_3, C_3 = np.zeros((N, 3, 3)), np.zeros((N, 3, 3))
    F_3[:, :2, :2], C_3[:, :2, :2], F_3[:, 2, 2] = F, C, 1.0
    close(solid.tau(F_3, C_3, theta)[:, :2, :2], flat.tau(F, C))


@HYPERELASTIC
@DIM
def test_the_stress_has_an_energy(name, dim, rng):
    """dP/dF is symmetric: B : dP[A] = A : dP[B]. A law that fails this gives work away in a cycle."""
    term, (F, C) = make(name, dim, rng), states(dim, rng)
    A, B = rng.normal(size=(2, N, dim, dim))

    def dP(direction: np.ndarray) -> np.ndarray:
        def P(h: float) -> np.ndarray:
            moved = F + h * direction
            return term.tau(moved, C) @ t(np.linalg.inv(moved))

        return richardson(P)

    close((B * dP(A)).sum((1, 2)), (A * dP(B)).sum((1, 2)), 1e-9)


def _fixed_corotated_energy(mu: Any, lam: Any, F: np.ndarray) -> np.ndarray:
    stretch = F - matrices(polar(entries(F)))
    return mu * (stretch**2).sum((1, 2)) + lam / 2 * (np.linalg.det(F) - 1) ** 2


def _neo_hookean_energy(mu: Any, lam: Any, F: np.ndarray) -> np.ndarray:
    log_J = np.log(np.linalg.det(F))
    return mu / 2 * ((F**2).sum((1, 2)) - F.shape[-1] - 2 * log_J) + lam / 2 * log_J**2


def _penalty(power: int) -> Any:
    # kappa = lam + 2/3 mu
    return lambda mu, lam, F: (lam + 2 / 3 * mu) / 2 * (np.linalg.det(F) - 1) ** power


ENERGIES = {
    "fixed_corotated": _fixed_corotated_energy, "neo_hookean": _neo_hookean_energy,
    "incompressibility": _penalty(2), "incompressibility^4": _penalty(4),
}  # fmt: skip
"""Energy densities [J/m^D] of mu, lam, F."""


@pytest.mark.parametrize("name", ENERGIES)
@DIM
def test_the_stress_is_that_of_the_papers_energy(name, dim, rng):
    term, (F, C) = make(name, dim, rng), states(dim, rng)
    F_dot = rng.normal(size=F.shape)
    power = richardson(lambda h: ENERGIES[name](*lame(*term.theta), F + h * F_dot))
    P = term.tau(F, C) @ t(np.linalg.inv(F))
    close((P * F_dot).sum((1, 2)), power, 1e-9)


@ELASTIC
@DIM
def test_small_strains_obey_hooke(name, dim, rng):
    """tau = lam tr(e) I + 2 mu e, turned with the body, up to terms in e^2."""
    term, Q = make(name, dim, rng), rotations(dim, rng)
    e = rng.normal(size=(N, dim, dim))
    e = 1e-7 * (e + t(e))
    mu = term.spec.shear_modulus(term.theta)
    lam = (term.spec.wave_modulus(term.theta) - 2 * mu)[:, None, None]
    mu = mu[:, None, None]
    hooke = 2 * mu * e + lam * np.trace(e, axis1=1, axis2=2)[:, None, None] * np.eye(dim)
    close(term.tau(Q @ (np.eye(dim) + e), 0 * e) / 1e-7, Q @ hooke @ t(Q) / 1e-7, 1e-5)


@pytest.mark.parametrize("name", [n for n in all_names() if n != "muscle" and not n.startswith("fibre:")])
@DIM
def test_what_a_term_tells_the_time_step(name, dim, rng):
    """wave_modulus and wave_viscosity are the slopes of tau_xx by F_xx and C_xx at rest."""
    term, rest = make(name, dim, rng), np.tile(np.eye(dim), (N, 1, 1))
    pull = np.zeros((N, dim, dim))
    pull[:, 0, 0] = 1.0
    slope = richardson(lambda h: term.tau(rest + h * pull, 0 * pull))[:, 0, 0]
    np.testing.assert_allclose(term.spec.wave_modulus(term.theta), slope, rtol=1e-9, atol=1e-9)
    viscous = term.tau(rest, pull)[:, 0, 0]
    np.testing.assert_allclose(term.spec.wave_viscosity(term.theta), viscous, rtol=1e-12, atol=1e-12)


# --- viscosity and muscles -------------------------------------------------------------------------------


@DIM
def test_viscosity_does_not_oppose_a_rotation(dim, rng):
    term, (F, C) = make("viscosity", dim, rng), states(dim, rng)
    close(term.tau(F, C - t(C)), np.zeros_like(C))


@DIM
def test_viscosity_only_takes_energy(dim, rng):
    """tau : d >= 0, and > 0 where shear viscosity meets any strain rate (in 2D the rate out of the plane is 0)."""
    term, (F, C) = make("viscosity", dim, rng), states(dim, rng)
    d = (C + t(C)) / 2
    power = (term.tau(F, C) * d).sum((1, 2))
    assert np.all(power > 0)
    bulk_only = term.tau(F, C, term.theta * np.array([[0.0], [1.0]]))
    close((bulk_only * d).sum((1, 2)), np.linalg.det(F) * term.theta[1] * np.trace(d, axis1=1, axis2=2) ** 2)
    assert np.all((term.tau(F, C, term.theta * np.array([[1.0], [0.0]])) * d).sum((1, 2)) > 0)


@DIM
def test_viscosity_of_simple_shear_and_of_compression(dim):
    """A shear rate g gives tau_xy = J eta g; a rate of volume alone, in 3D, tau = J zeta tr(d) I."""
    term, F = make("viscosity", dim, np.random.default_rng(0)), np.tile(1.1 * np.eye(dim), (N, 1, 1))
    shear = np.zeros_like(F)
    shear[:, 0, 1] = 3.0
    close(term.tau(F, shear)[:, 0, 1], 1.1**dim * term.theta[0] * 3.0)
    if dim == 3:
        swell = np.tile(2.0 * np.eye(3), (N, 1, 1))
        close(term.tau(F, swell), 1.1**3 * (term.theta[1] * 6.0)[:, None, None] * np.eye(3))


@DIM
def test_a_positive_activation_is_a_tension_along_the_deformed_axis(dim, rng):
    """S = a n n^T gives tau = a (F n)(F n)^T: work a (|F n|^2)' / 2 must be put in to lengthen the fibre."""
    term, (F, C) = make("muscle", dim, rng), states(dim, rng)
    n = rng.normal(size=dim)
    rows = symmetric_rows(2.5 * np.outer(n, n))
    tau = term.tau(F, C, np.tile(rows[:, None], N))
    fibre = F @ n
    close(tau, 2.5 * fibre[:, :, None] * fibre[:, None, :])
    close(np.array(from_rows(tuple(rows))).reshape(dim, dim), 2.5 * np.outer(n, n))


# --- what the papers print -------------------------------------------------------------------------------


def test_the_derivative_of_lam_by_nu_is_not_the_printed_one():
    """CQ2 (A98)-(A100) print (1 + 2 nu)^2 where 1 + 2 nu^2 belongs, and + phi / (1 + nu) where - belongs."""
    E, nu, h = 3.0, 0.3, 1e-30
    mu, lam = lame(E, nu + 1j * h)
    assert lame_vjp(E, nu, 0.0, 1.0)[1] == pytest.approx(lam.imag / h, rel=1e-14)
    assert lame_vjp(E, nu, 1.0, 0.0)[1] == pytest.approx(mu.imag / h, rel=1e-14)
    printed = E * (1 + 2 * nu) ** 2 / ((1 + nu) ** 2 * (1 - 2 * nu) ** 2)
    assert abs(printed / lame_vjp(E, nu, 0.0, 1.0)[1] - 1) > 1
    assert lame_vjp(E, nu, 1.0, 0.0)[1] < 0
    mu, lam = lame(E + 1j * h, nu)
    assert lame_vjp(E, nu, 2.0, 5.0)[0] == pytest.approx((2 * mu.imag + 5 * lam.imag) / h, rel=1e-14)


@pytest.mark.parametrize("name", ["fixed_corotated", "neo_hookean"])
@DIM
def test_the_derivative_by_E_is_not_the_printed_one(name, dim, rng):
    """It is (tau_bar : tau) / E. CQ2 (A95) prints the sum of tau_bar / E, five times less in a case tried."""
    term, (F, C) = make(name, dim, rng), states(dim, rng)
    tau_bar = rng.normal(size=F.shape)
    E_bar = term.vjp(F, C, tau_bar)[0][0]
    close(E_bar, (tau_bar * term.tau(F, C)).sum((1, 2)) / term.theta[0])
    assert np.abs(E_bar - tau_bar.sum((1, 2)) / term.theta[0]).max() > 0.1 * np.abs(E_bar).max()


def test_incompressibility_of_an_odd_power_is_refused():
    with pytest.raises(ValueError, match="3 is odd: the penalty would push in the same direction for J < 1 and J > 1"):
        Incompressibility(power=3)
    assert Incompressibility().power == 2


def test_incompressibility_adds_the_bulk_modulus_not_the_printed_factor(rng):
    """CQ2 eq 14 prints E / (3 (2 - 2 nu)); with 2 - 4 nu it is kappa / 2, that of Bonet and Wood, whom it cites."""
    term = make("incompressibility", 3, rng)
    E, nu = term.theta
    slope = richardson(lambda h: term.tau((1 + h) * np.tile(np.eye(3), (N, 1, 1)), np.zeros((N, 3, 3))))[:, 0, 0]
    close(slope, 3 * bulk_modulus(E, nu), 1e-9)  # J' = 3
    assert np.abs(slope / (2 * E / (2 - 2 * nu)) - 1).max() > 0.1


def test_incompressibility_pushes_back_both_ways(rng):
    for name in ("incompressibility", "incompressibility^4"):
        term = make(name, 3, rng)
        C = np.zeros((N, 3, 3))
        assert np.all(term.tau(0.9 * np.eye(3) + C, C)[:, 0, 0] < 0)
        assert np.all(term.tau(1.1 * np.eye(3) + C, C)[:, 0, 0] > 0)


# --- compiled --------------------------------------------------------------------------------------------


@kernel
def on_lanes(terms, terms_bar, table, out, width, dims):
    """Sum all terms and their adjoints on lanes: rows of `table` are F, C, tau_bar, of `out` tau, F_bar, C_bar."""
    for i in range(0, table.shape[0] * width, width):
        if len(dims) == 2:
            F = (load(table, 0, i), load(table, 1, i), load(table, 2, i), load(table, 3, i))
            C = (load(table, 4, i), load(table, 5, i), load(table, 6, i), load(table, 7, i))
            b = (load(table, 8, i), load(table, 9, i), load(table, 10, i), load(table, 11, i))
        else:
            F = (
                load(table, 0, i), load(table, 1, i), load(table, 2, i), load(table, 3, i), load(table, 4, i),
                load(table, 5, i), load(table, 6, i), load(table, 7, i), load(table, 8, i),
            )  # fmt: skip
            C = (
                load(table, 9, i), load(table, 10, i), load(table, 11, i), load(table, 12, i), load(table, 13, i),
                load(table, 14, i), load(table, 15, i), load(table, 16, i), load(table, 17, i),
            )  # fmt: skip
            b = (
                load(table, 18, i), load(table, 19, i), load(table, 20, i), load(table, 21, i), load(table, 22, i),
                load(table, 23, i), load(table, 24, i), load(table, 25, i), load(table, 26, i),
            )  # fmt: skip
        tau = total_kirchhoff(terms, table, table, i, F, C, 0.0)
        F_bar, C_bar = total_kirchhoff_vjp(terms, terms_bar, table, out, i, F, C, 0.0, b)
        row = 0
        for a in (tau, F_bar, C_bar):
            for entry in a:
                store(out, row, i, entry)
                row += 1


def _parameters(part: Term) -> tuple[str, ...]:
    return getattr(part.spec, "parameters", ("activation",) * len(part.theta))


def _divides(parameter: str) -> bool:
    """Return whether a parameter stays as it is where a term is switched off by its moduli."""
    return parameter in ("poissons_ratio", "jm", "lock") or parameter.startswith("alpha")


def _only(parts: list[Term], on: int, n: int, real: type) -> list[np.ndarray]:
    """Return parameters (rows, n) of every term, all stiffness and viscosity zero but those of term `on`."""
    thetas = []
    for k, part in enumerate(parts):
        theta = np.repeat(part.theta[:, :1], n, axis=1).astype(real).astype(float)
        if k != on:
            theta[[not _divides(parameter) for parameter in _parameters(part)]] = 0.0
        thetas.append(theta)
    return thetas


@pytest.mark.parametrize(
    ("dim", "real", "tolerance"), [(3, np.float64, 1e-12), (2, np.float32, 1e-4)], ids=["3D float64", "2D float32"]
)
def test_compiled_terms_are_their_plain_twins(dim, real, tolerance, rng):
    """All terms in one kernel, which takes a quarter of a GB, each switched on in turn by its own parameters."""
    width = lane_width(real)
    n = 2 * width
    parts = [make(name, dim, rng) for name in all_names() if name != "incompressibility^4"]
    (F, C), tau_bar = states(dim, rng, 0.1), rng.normal(size=(N, dim, dim))  # within Gent's limit
    F, C, tau_bar = (np.resize(a, (n, dim, dim)).astype(real).astype(float) for a in (F, C, tau_bar))
    table = pack(np.concatenate([entries(F), entries(C), entries(tau_bar)]), real)
    for on, part in enumerate(parts):
        thetas = _only(parts, on, n, real)
        terms = tuple(p.kernel._replace(theta=pack(theta, real)) for p, theta in zip(parts, thetas, strict=True))
        bars = tuple(term._replace(theta=np.zeros_like(term.theta)) for term in terms)
        out = np.zeros((table.shape[0], 3 * dim * dim, width), real)
        on_lanes(terms, bars, table, out, width, (0,) * dim)
        theta = tuple(thetas[on])
        tau = kirchhoff(part.kernel, theta, entries(F), entries(C))
        theta_bar, F_bar, C_bar = kirchhoff_vjp(part.kernel, theta, entries(F), entries(C), entries(tau_bar))
        want = np.array([*tau, *F_bar, *C_bar])
        np.testing.assert_allclose(unpack(out), want, rtol=0, atol=tolerance * np.abs(want).max(), err_msg=part.name)
        want = np.array([b + np.zeros(n) for b in theta_bar])
        np.testing.assert_allclose(unpack(bars[on].theta), want, rtol=0, atol=tolerance * np.abs(want).max())
