"""The stress that relaxes: adjoints, closed forms of one particle, rigid motions, and what a scene may give."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from constitutive import N, entries, matrices, richardson, rotations, states, t
from little_worlds import needs_jit

from cqrun.materials.prony import Prony, RelaxingKernel, shape_stress
from cqrun.materials.term import (
    in_motion,
    kirchhoff,
    settled,
    settled_vjp,
    stress_and_history,
    stress_and_history_both,
    stress_and_history_vjp,
)
from cqrun.numerics.compile import kernel
from cqrun.numerics.lanes import lane_width
from cqrun.numerics.packed import load, pack, store, unpack
from cqrun.numerics.symmetric import from_rows
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
        elastic = plugins("elastic")[law](**LAWS[law])
        self.spec.bind(elastic)
        values = [getattr(self.spec, p, None) or getattr(elastic, p) for p in self.spec.parameters]
        vary = 1.0 if rng is None else 1.0 + 0.1 * rng.uniform(-1, 1, (len(values), N))
        self.theta = np.tile(np.array(values)[:, None], N) * vary
        self.kernel = self.spec.kernel_term(None)
        self.n = n
        self.n_rows = {dim: n * dim * (dim + 1) // 2 for dim in (2, 3)}

    def moving(self, dt, theta=None):
        """Return the view in motions for substeps dt, and its parameters."""
        theta = self.theta if theta is None else theta
        a = np.exp(-0.5 * dt / theta[1 : 2 * self.n : 2])
        view = RelaxingKernel(None, (0,) * (len(theta) + self.n), (), self.kernel.branches, self.kernel.base)
        return view, (*theta, *a)

    def step(self, F, h, dt, theta=None):
        """Return the stress (N, D, D) at F and the history after a substep."""
        tau, new = stress_and_history(*self.moving(dt, theta), entries(F), entries(0 * F), tuple(h), dt)
        return matrices(tau), np.array(new)

    def settled(self, F, dt, theta=None):
        """Return the history after a long rest at F."""
        return np.array(settled(*self.moving(dt, theta), entries(F), dt))

    def law(self, F):
        """Return the stress of the elastic law, and the rows of S."""
        theta = tuple(self.theta[2 * self.n :])
        tau = matrices(kirchhoff(self.kernel.base, theta, entries(F), entries(0 * F)))
        return tau, np.array(shape_stress(self.kernel, theta, entries(F)))


def rows_of(theta_bar, n):
    """Return the cotangents of the parameters, without the rows that follow from the times."""
    return np.array([row + np.zeros(N) for row in theta_bar[:-n]])


@LAW
@BRANCHES
@DIM
def test_dot_product(law, n, dim, rng):
    """Of the stress and of the history after a substep, by the parameters, by F and by the history before it."""
    term, (F, _), dt = Relaxing(law, n, rng), states(dim, rng, 0.2), 0.03
    h, h_dot, h_bar = rng.normal(size=(3, term.n_rows[dim], N))
    F_dot, tau_bar = rng.normal(size=(2, *F.shape))
    theta_dot = 0.1 * term.theta * rng.normal(size=term.theta.shape)
    given = (*term.moving(dt), entries(F), entries(0 * F), tuple(h), dt)
    found = stress_and_history_vjp(*given, entries(tau_bar), tuple(h_bar))
    zero = (0 * theta_dot, 0 * F_dot, 0 * h_dot)
    pairs = [(theta_dot, rows_of(found[0], n)), (F_dot, matrices(found[1])), (h_dot, np.array(found[3]))]
    for which, (dot, found_bar) in enumerate(pairs):
        d = tuple(dot if k == which else zero[k] for k in range(3))

        def along(s, d=d):
            tau, new = term.step(F + s * d[1], h + s * d[2], dt, term.theta + s * d[0])
            return (tau * tau_bar).sum((1, 2)) + (new * h_bar).sum(0)

        forward, backward = richardson(along), (found_bar * dot).reshape(N, -1).sum(1)
        if found_bar.ndim == 2:
            backward = (found_bar * dot).sum(0)
        np.testing.assert_allclose(backward, forward, rtol=0, atol=1e-9 * np.abs(forward).max())
    both = stress_and_history_both(*given, entries(tau_bar), tuple(h_bar))
    np.testing.assert_allclose(matrices(both[0]), term.step(F, h, dt)[0], rtol=0, atol=1e-12 * np.abs(both[0]).max())
    for one, other in zip(both[1:], found, strict=True):
        np.testing.assert_array_equal(np.array([a + np.zeros(N) for a in one]), [b + np.zeros(N) for b in other])


@LAW
@BRANCHES
@DIM
def test_dot_product_of_the_history_after_a_long_rest(law, n, dim, rng):
    term, (F, _), dt = Relaxing(law, n, rng), states(dim, rng, 0.2), 0.03
    h_bar = rng.normal(size=(term.n_rows[dim], N))
    F_dot, theta_dot = rng.normal(size=F.shape), 0.1 * term.theta * rng.normal(size=term.theta.shape)
    theta_bar, F_bar = settled_vjp(*term.moving(dt), entries(F), dt, tuple(h_bar))
    forward = richardson(lambda s: (term.settled(F + s * F_dot, dt) * h_bar).sum(0))
    backward = (matrices(F_bar) * F_dot).sum((1, 2))
    np.testing.assert_allclose(backward, forward, rtol=0, atol=1e-9 * np.abs(forward).max())
    forward = richardson(lambda s: (term.settled(F, dt, term.theta + s * theta_dot) * h_bar).sum(0))
    backward = (rows_of(theta_bar, n) * theta_dot).sum(0)
    np.testing.assert_allclose(backward, forward, rtol=0, atol=1e-9 * np.abs(forward).max())


@LAW
@DIM
def test_after_a_long_rest_the_stress_is_the_laws_and_nothing_changes(law, dim, rng):
    term, (F, _) = Relaxing(law, 2, rng), states(dim, rng)
    h = term.settled(F, 0.01)
    tau, new = term.step(F, h, 0.01)
    expected, _ = term.law(F)
    np.testing.assert_allclose(tau, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_allclose(new, h, rtol=0, atol=1e-12 * np.abs(h).max())


@LAW
@DIM
def test_the_stress_is_the_laws_and_that_of_simos_branches(law, dim, rng):
    """Over a few substeps with random F, H_i' = a_i^2 H_i + g_i a_i (S(F') - S(F)) gives the same stress."""
    term, dt = Relaxing(law, 2, rng), 0.01
    g, a = term.theta[0:4:2], np.exp(-0.5 * dt / term.theta[1:4:2])
    h, H, S = np.zeros((term.n_rows[dim], N)), np.zeros((2, term.n_rows[dim] // 2, N)), 0.0
    for _ in range(4):
        F, _ = states(dim, rng, 0.2)
        (elastic, now), (tau, h) = term.law(F), term.step(F, h, dt)
        H, S = a[:, None] ** 2 * H + (g * a)[:, None] * (now - S), now
        expected = elastic + F @ matrices(from_rows(tuple(H.sum(0)))) @ t(F)
        np.testing.assert_allclose(tau, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def relaxing_part(term, F, h, dt):
    """Return the rows of the sum of all H = Q + g a S."""
    a = np.exp(-0.5 * dt / term.theta[1 : 2 * term.n : 2])
    weight = (term.theta[0 : 2 * term.n : 2] * a).sum(0)
    return h.reshape(term.n, -1, N).sum(0) + weight * term.law(F)[1]


@LAW
def test_relaxation_of_one_particle(law):
    """After a sudden stretch, tau - tau_elastic is sum g_i exp(-t/t_i) times the stress without the volume's."""
    term, dt = Relaxing(law, 2), 1e-3
    F = np.tile(np.diag([1.3, 1.3**-0.5, 1.3**-0.5]), (N, 1, 1))
    h, S = np.zeros((term.n_rows[3], N)), term.law(F)[1]
    for k in range(200):  # the stretch comes in the middle of a substep
        times = term.theta[1:4:2]
        expected = (term.theta[0:4:2] * np.exp(-(k + 0.5) * dt / times)).sum(0) * S
        found = relaxing_part(term, F, h, dt)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(S).max())
        h = term.step(F, h, dt)[1]


def test_loss_angle_over_four_decades():
    """Small strains at a frequency w: E' = 1 + sum g w^2 t^2 / (1 + w^2 t^2), E'' = sum g w t / (1 + w^2 t^2)."""
    term = Relaxing("yeoh", 1, ratio_1=0.5, time_1=0.1)
    for w in 10.0 ** np.array([-1, 0, 1, 2, 3]):
        steps = max(200, round(2 * np.pi / w / 0.02))  # a fifth of the relaxation time at most
        dt = 2 * np.pi / w / steps
        periods = max(3, int(np.ceil(4 * 0.1 / (dt * steps))))  # until the start has faded
        e = 1e-6 * np.sin(2 * np.pi * np.arange(periods * steps + 1) / steps)
        h, stresses = np.zeros((6, N)), []
        F = [np.tile(np.diag([1 + a, 1 - a / 2, 1 - a / 2]), (N, 1, 1)) for a in e[: steps + 1]]
        for k in range(periods * steps + 1):
            if k > (periods - 1) * steps:
                stresses.append(relaxing_part(term, F[k % steps], h, dt)[0, 0] + term.law(F[k % steps])[1][0, 0])
            h = term.step(F[k % steps], h, dt)[1]
        angle = 2 * np.pi * np.arange(1, steps + 1) / steps
        storage, loss = np.array(stresses) @ np.sin(angle), np.array(stresses) @ np.cos(angle)
        x = w * 0.1
        expected = 0.5 * x / (1 + x * x) / (1 + 0.5 * x * x / (1 + x * x))
        assert loss / storage == pytest.approx(expected, rel=0.02)


@LAW
@DIM
def test_a_rigid_motion_changes_no_history_and_turns_the_stress(law, dim, rng):
    term, (F, _), Q = Relaxing(law, 2, rng), states(dim, rng), rotations(dim, rng)
    h = rng.normal(size=(term.n_rows[dim], N))
    (tau, new), (turned, same) = term.step(F, h, 0.01), term.step(Q @ F, h, 0.01)
    np.testing.assert_allclose(same, new, rtol=0, atol=1e-12 * np.abs(h).max())
    np.testing.assert_allclose(turned, Q @ tau @ t(Q), rtol=0, atol=1e-12 * np.abs(tau).max() * 9)


@LAW
def test_a_cycle_never_gives_energy(law, rng):
    """The work of the stress over a closed path from rest and back, until it has faded, is a loss."""
    term = Relaxing(law, 2)
    size = 0.3 * rng.uniform(0.3, 1, N)
    work, h, before = np.zeros(N), np.zeros((12, N)), None
    for angle in np.linspace(0, 4 * np.pi, 801):
        F = np.tile(np.eye(3), (N, 1, 1))
        F[:, 0, 1] = size * np.sin(angle)
        tau, h = term.step(F, h, 0.002)
        P = tau @ t(np.linalg.inv(F))
        if before is not None:
            work += (0.5 * (P + before[0]) * (F - before[1])).sum((1, 2))
        before = P, F
    assert (work > 0).all()


@kernel
def on_lanes(term, table, out, width, dt):
    for i in range(0, table.shape[0] * width, width):
        F = (load(table, 0, i), load(table, 1, i), load(table, 2, i), load(table, 3, i))
        h = (
            load(table, 4, i), load(table, 5, i), load(table, 6, i), load(table, 7, i), load(table, 8, i),
            load(table, 9, i),
        )  # fmt: skip
        theta = (
            load(term.theta, 0, i), load(term.theta, 1, i), load(term.theta, 2, i), load(term.theta, 3, i),
            load(term.theta, 4, i), load(term.theta, 5, i), load(term.theta, 6, i), load(term.theta, 7, i),
            load(term.theta, 8, i), load(term.theta, 9, i),
        )  # fmt: skip
        tau, new = stress_and_history(term, theta, F, F, h, dt)
        bars = stress_and_history_vjp(term, theta, F, F, h, dt, tau, new)
        rest = settled(term, theta, F, dt)
        rest_bars = settled_vjp(term, theta, F, dt, new)
        row = 0
        for entry in tau:
            store(out, row, i, entry)
            row += 1
        for part in (new, rest, bars[3]):
            for entry in part:
                store(out, row, i, entry)
                row += 1
        for entry in bars[0]:
            store(out, row, i, entry)
            row += 1
        for entry in bars[1]:
            store(out, row, i, entry)
            row += 1
        for entry in rest_bars[0]:
            store(out, row, i, entry)
            row += 1
        for entry in rest_bars[1]:
            store(out, row, i, entry)
            row += 1


@needs_jit
@pytest.mark.parametrize(("real", "tolerance"), [(np.float64, 1e-12), (np.float32, 1e-4)])
def test_compiled_it_is_its_plain_twin(real, tolerance, rng):
    term, width, dt = Relaxing("yeoh", 2), lane_width(real), 0.01
    n = width * -(-N // width)
    F, _ = states(2, rng, 0.2)
    given = np.concatenate([np.array(entries(F)), rng.normal(size=(6, N))])
    given, theta = (np.resize(a.T, (n, len(a))).T.astype(real).astype(float) for a in (given, term.theta))
    table, view = pack(given, real), in_motion(term.kernel._replace(theta=pack(theta, real)), dt)
    assert type(view) is RelaxingKernel
    out = np.zeros((table.shape[0], 4 + 6 + 6 + 6 + 10 + 4 + 10 + 4, width), real)
    on_lanes(view, table, out, width, dt)
    F, h = tuple(given[:4]), tuple(given[4:])
    kernel, theta = term.moving(dt, theta)
    tau, new = stress_and_history(kernel, theta, F, F, h, dt)
    bars = stress_and_history_vjp(kernel, theta, F, F, h, dt, tau, new)
    rest_bars = settled_vjp(kernel, theta, F, dt, new)
    wanted = [*tau, *new, *settled(kernel, theta, F, dt), *bars[3], *bars[0], *bars[1], *rest_bars[0], *rest_bars[1]]
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
