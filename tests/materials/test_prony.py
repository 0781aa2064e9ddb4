"""The stress that relaxes: adjoints, closed forms of one particle, rigid motions, and what a scene may give."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from constitutive import N, entries, matrices, richardson, rotations, states, t
from little_worlds import needs_jit

from cqrun.materials.prony import Prony, RelaxingKernel, shape_stress
from cqrun.materials.term import in_motion, kirchhoff, kirchhoff_vjp, update, update_vjp
from cqrun.numerics.compile import kernel
from cqrun.numerics.lanes import lane_width
from cqrun.numerics.packed import load, pack, store, unpack
from cqrun.plugin.registry import plugins

DIM = pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])
LAWS: dict[str, dict[str, float]] = {
    "neo_hookean": {"youngs_modulus": 3.0, "poissons_ratio": 0.45},
    "fixed_corotated": {"youngs_modulus": 3.0, "poissons_ratio": 0.45},
    "yeoh": {"c10": 0.5, "c20": -0.01, "c30": 0.002, "poissons_ratio": 0.49},
    "ogden": {"mu_1": 0.8, "alpha_1": 2.5, "bulk_modulus": 20.0},
}
LAW = pytest.mark.parametrize("law", LAWS)
BRANCHES = pytest.mark.parametrize("n", [1, 3])


class Relaxing:
    """A law with branches at N particles, and its parameters."""

    def __init__(self, law: str, n: int, rng: Any = None, **fixed: float) -> None:
        given = {f"ratio_{k}": 0.1 * k for k in range(1, n + 1)} | {f"time_{k}": 0.02 * 3.0**k for k in range(1, n + 1)}
        self.spec = Prony(**(given | fixed))
        self.law = plugins("elastic")[law](**LAWS[law])
        self.spec.bind(self.law)
        values = [getattr(self.spec, p, None) or getattr(self.law, p) for p in self.spec.parameters]
        vary = 1.0 if rng is None else 1.0 + 0.1 * rng.uniform(-1, 1, (len(values), N))
        self.theta = np.tile(np.array(values)[:, None], N) * vary
        self.kernel = self.spec.kernel_term(None)
        self.n = n
        self.n_rows = {dim: (n + 1) * dim * (dim + 1) // 2 for dim in (2, 3)}

    def tau(self, F, h, theta=None):
        theta = self.theta if theta is None else theta
        return matrices(kirchhoff(self.kernel, tuple(theta), entries(F), entries(0 * F), tuple(h)))

    def moving(self, dt, theta=None):
        """Return the view in motions for substeps dt, and its parameters."""
        theta = self.theta if theta is None else theta
        half = np.exp(-0.5 * dt / theta[1 : 2 * self.n : 2])
        return RelaxingKernel(None, (0,) * (len(theta) + self.n), *self.kernel[2:]), (*theta, *half)

    def next(self, F, h, dt, theta=None):
        kernel, theta = self.moving(dt, theta)
        return np.array(update(kernel, theta, entries(F), tuple(h), dt))

    def at(self, F, h):
        """Return a history with the stress of the law at F in its last rows."""
        S = np.array(shape_stress(self.kernel, tuple(self.theta[2 * self.n :]), entries(F)))
        return np.concatenate([h[: -len(S)], S])


@LAW
@BRANCHES
@DIM
def test_dot_product_of_the_stress(law, n, dim, rng):
    term, (F, _) = Relaxing(law, n, rng), states(dim, rng)
    h, h_dot = rng.normal(size=(2, term.n_rows[dim], N))
    F_dot, tau_bar = rng.normal(size=(2, *F.shape))
    forward = richardson(lambda s: (term.tau(F + s * F_dot, h + s * h_dot) * tau_bar).sum((1, 2)))
    found = kirchhoff_vjp(term.kernel, tuple(term.theta), entries(F), entries(0 * F), tuple(h), entries(tau_bar))
    backward = (matrices(found[1]) * F_dot).sum((1, 2)) + (np.array(found[3]) * h_dot).sum(0)
    np.testing.assert_allclose(backward, forward, rtol=0, atol=1e-9 * np.abs(forward).max())
    assert not np.any(found[0])


@LAW
@BRANCHES
@DIM
def test_dot_product_of_the_stress_in_motion(law, n, dim, rng):
    term, (F, _) = Relaxing(law, n, rng), states(dim, rng)
    kernel, dt = term.moving(0.03)[0], 0.03
    h, h_dot = rng.normal(size=(2, term.n_rows[dim], N))
    F_dot, tau_bar = rng.normal(size=(2, *F.shape))
    theta_dot = 0.1 * term.theta * rng.normal(size=term.theta.shape)

    def along(s):
        theta = term.moving(dt, term.theta + s * theta_dot)[1]
        tau = kirchhoff(kernel, theta, entries(F + s * F_dot), entries(0 * F), tuple(h + s * h_dot))
        return (matrices(tau) * tau_bar).sum((1, 2))

    forward = richardson(along)
    found = kirchhoff_vjp(kernel, term.moving(dt)[1], entries(F), entries(0 * F), tuple(h), entries(tau_bar))
    backward = (matrices(found[1]) * F_dot).sum((1, 2)) + (np.array(found[3]) * h_dot).sum(0)
    backward += (np.array([row + np.zeros(N) for row in found[0][:-n]]) * theta_dot).sum(0)
    np.testing.assert_allclose(backward, forward, rtol=0, atol=1e-9 * np.abs(forward).max())


@LAW
@DIM
def test_in_motion_the_stress_is_the_laws_and_that_of_the_branches(law, dim, rng):
    term, (F, _) = Relaxing(law, 2, rng), states(dim, rng)
    h = term.at(F, rng.normal(size=(term.n_rows[dim], N)))
    theta = tuple(term.theta[4:])
    apart = matrices(kirchhoff(term.spec._law.kernel_term(None), theta, entries(F), entries(0 * F), ()))
    apart += term.tau(F, h)
    kernel, theta = term.moving(0.01)
    both = matrices(kirchhoff(kernel, theta, entries(F), entries(0 * F), tuple(h)))
    np.testing.assert_allclose(both, apart, rtol=0, atol=1e-12 * np.abs(apart).max())


@LAW
@BRANCHES
@DIM
def test_dot_product_of_the_update(law, n, dim, rng):
    term, (F, _) = Relaxing(law, n, rng), states(dim, rng, 0.2)
    h, h_dot, bar = rng.normal(size=(3, term.n_rows[dim], N))
    F_dot = rng.normal(size=F.shape)
    theta_dot = 0.1 * term.theta * rng.normal(size=term.theta.shape)
    dt = 0.03
    kernel, theta = term.moving(dt)
    found = update_vjp(kernel, theta, entries(F), tuple(h), dt, tuple(bar))
    zero = (0 * theta_dot, 0 * F_dot, 0 * h_dot)
    pairs = [
        (theta_dot, np.array([b + np.zeros(N) for b in found[0][:-n]])),
        (F_dot, matrices(found[1])),
        (h_dot, np.array(found[2])),
    ]
    for which, (dot, found_bar) in enumerate(pairs):
        d = tuple(dot if k == which else zero[k] for k in range(3))

        def along(s, d=d):
            new = term.next(F + s * d[1], h + s * d[2], dt, term.theta + s * d[0])
            return (new * bar).sum(0)

        forward = richardson(along)
        product = found_bar * dot
        backward = product.sum(0) if product.ndim == 2 else product.sum((1, 2))
        np.testing.assert_allclose(backward, forward, rtol=0, atol=1e-9 * max(np.abs(forward).max(), 1e-3))


@LAW
def test_relaxation_of_one_particle(law):
    """After a sudden stretch, tau - tau_elastic is sum g_i exp(-t/t_i) times the stress without the volume's."""
    term, dt = Relaxing(law, 2), 1e-3
    F = np.tile(np.diag([1.3, 1.3**-0.5, 1.3**-0.5]), (N, 1, 1))
    h = np.zeros((term.n_rows[3], N))
    h = term.next(F, h, 1e-12)  # at once
    S = np.array(shape_stress(term.kernel, tuple(term.theta[4:]), entries(F)))
    for k in range(200):
        expected = sum(term.theta[2 * i] * np.exp(-k * dt / term.theta[2 * i + 1]) for i in range(2)) * S
        np.testing.assert_allclose(h[:6] + h[6:12], expected, rtol=0, atol=1e-9 * np.abs(S).max())
        h = term.next(F, h, dt)


def test_loss_angle_over_four_decades():
    """Small strains at a frequency w: E' = 1 + sum g w^2 t^2 / (1 + w^2 t^2), E'' = sum g w t / (1 + w^2 t^2)."""
    term = Relaxing("yeoh", 1, ratio_1=0.5, time_1=0.1)
    for w in 10.0 ** np.array([-1, 0, 1, 2, 3]):
        steps = max(200, round(2 * np.pi / w / 0.02))  # a fifth of the relaxation time at most
        dt = 2 * np.pi / w / steps
        periods = max(3, int(np.ceil(4 * 0.1 / (dt * steps))))  # until the start has faded
        e = 1e-6 * np.sin(2 * np.pi * np.arange(periods * steps + 1) / steps)
        h, stresses = np.zeros((12, N)), []
        F = [np.tile(np.diag([1 + a, 1 - a / 2, 1 - a / 2]), (N, 1, 1)) for a in e[: steps + 1]]
        for k in range(periods * steps):
            h = term.next(F[k % steps + 1], h, dt)
            if k >= (periods - 1) * steps:
                stresses.append(h[0, 0] + h[6, 0])
        angle = 2 * np.pi * np.arange(1, steps + 1) / steps
        storage, loss = np.array(stresses) @ np.sin(angle), np.array(stresses) @ np.cos(angle)
        x = w * 0.1
        expected = 0.5 * x / (1 + x * x) / (1 + 0.5 * x * x / (1 + x * x))
        assert loss / storage == pytest.approx(expected, rel=0.02)


@LAW
@DIM
def test_a_rigid_motion_changes_no_history_and_turns_the_stress(law, dim, rng):
    term, (F, _), Q = Relaxing(law, 2, rng), states(dim, rng), rotations(dim, rng)
    h = term.at(F, rng.normal(size=(term.n_rows[dim], N)))
    fading = term.next(F, h, 0.01)
    np.testing.assert_allclose(term.next(Q @ F, h, 0.01), fading, rtol=0, atol=1e-12 * np.abs(h).max())
    np.testing.assert_allclose(term.tau(Q @ F, h), Q @ term.tau(F, h) @ t(Q), rtol=0, atol=1e-12 * np.abs(h).max() * 9)
    relaxing = slice(None, -dim * (dim + 1) // 2)
    assert np.abs(fading[relaxing]).max() < np.abs(h[relaxing]).max()


@LAW
def test_a_cycle_never_gives_energy(law, rng):
    """The work of the relaxing stress over a closed path from rest and back, until it has faded, is a loss."""
    term = Relaxing(law, 2)
    size = 0.3 * rng.uniform(0.3, 1, N)
    work, h = np.zeros(N), np.zeros((18, N))
    angle = np.linspace(0, 4 * np.pi, 801)
    for before, after in itertools.pairwise(angle):
        F, G = (np.tile(np.eye(3), (N, 1, 1)) for _ in range(2))
        F[:, 0, 1], G[:, 0, 1] = size * np.sin(before), size * np.sin(after)
        new = term.next(G, h, 0.002)
        P = 0.5 * (term.tau(F, h) @ t(np.linalg.inv(F)) + term.tau(G, new) @ t(np.linalg.inv(G)))
        work += (P * (G - F)).sum((1, 2))
        h = new
    assert (work > 0).all()


@kernel
def on_lanes(term, table, out, width, dt):
    for i in range(0, table.shape[0] * width, width):
        F = (load(table, 0, i), load(table, 1, i), load(table, 2, i), load(table, 3, i))
        h = (
            load(table, 4, i), load(table, 5, i), load(table, 6, i), load(table, 7, i), load(table, 8, i),
            load(table, 9, i), load(table, 10, i), load(table, 11, i), load(table, 12, i),
        )  # fmt: skip
        theta = (
            load(term.theta, 0, i), load(term.theta, 1, i), load(term.theta, 2, i), load(term.theta, 3, i),
            load(term.theta, 4, i), load(term.theta, 5, i), load(term.theta, 6, i), load(term.theta, 7, i),
            load(term.theta, 8, i), load(term.theta, 9, i),
        )  # fmt: skip
        new = update(term, theta, F, h, dt)
        bars = update_vjp(term, theta, F, h, dt, new)
        tau = kirchhoff(term, theta, F, F, new)
        row = 0
        for entry in new:
            store(out, row, i, entry)
            row += 1
        for entry in bars[0]:
            store(out, row, i, entry)
            row += 1
        for entry in bars[1]:
            store(out, row, i, entry)
            row += 1
        for entry in bars[2]:
            store(out, row, i, entry)
            row += 1
        for entry in tau:
            store(out, row, i, entry)
            row += 1


@needs_jit
@pytest.mark.parametrize(("real", "tolerance"), [(np.float64, 1e-12), (np.float32, 1e-4)])
def test_compiled_it_is_its_plain_twin(real, tolerance, rng):
    term, width = Relaxing("yeoh", 2), lane_width(real)
    n = width * -(-N // width)
    F, _ = states(2, rng, 0.2)
    given = np.concatenate([np.array(entries(F)), rng.normal(size=(9, N))])
    given, theta = (np.resize(a.T, (n, len(a))).T.astype(real).astype(float) for a in (given, term.theta))
    table, view = pack(given, real), in_motion(term.kernel._replace(theta=pack(theta, real)), 0.01)
    assert type(view) is RelaxingKernel
    out = np.zeros((table.shape[0], 9 + 10 + 4 + 9 + 4, width), real)
    on_lanes(view, table, out, width, 0.01)
    F, h = tuple(given[:4]), tuple(given[4:])
    kernel, theta = term.moving(0.01, theta)
    new = update(kernel, theta, F, h, 0.01)
    bars = update_vjp(kernel, theta, F, h, 0.01, new)
    wanted = [*new, *bars[0], *bars[1], *bars[2], *kirchhoff(kernel, theta, F, F, new)]
    wanted = np.array([row + np.zeros(n) for row in wanted])
    np.testing.assert_allclose(unpack(out), wanted, rtol=0, atol=tolerance * np.abs(wanted).max())


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"ratio_1": 0.1}, "time_1"),
        ({"ratio_1": 0.1, "time_1": 0.1, "ratio_2": 0.1}, "branch 2 needs both ratio_2 and time_2"),
        ({"ratio_1": 0.1, "time_1": 0.1, "ratio_3": 0.1, "time_3": 0.2}, "number the 2 branches from 1 on"),
        ({"ratio_1": -0.1, "time_1": 0.1}, "ratio_1"),
        ({"ratio_1": 0.1, "time_1": 0.0}, "time_1"),
    ],
)
def test_what_is_no_branch_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        Prony(**given)
