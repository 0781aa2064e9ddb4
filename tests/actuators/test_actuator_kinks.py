"""Each side of each kink, and what is chosen at it: cables just taut and fully reeled in, limits, rates."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import reference
from little_worlds import Acting, world
from rich_scene import make_complex

from cqrun.actuators.actuator import within_limits
from cqrun.actuators.cable import Cable
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import Inputs, LossBar, Model, Records

DOT_PRODUCT = 1e-9
TINY, BESIDE = 1e-30, 1e-12
STIFFNESS = 40.0
DIM = pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])

# --- a cable ----------------------------------------------------------------------------------------------------

ROUTE = (0, 1, 2)
AT = slice(2, 3)
"""Where the cable stands: after a muscle and a chamber of nothing."""

WANTED = ("x", "activation", "strength", "rest", "mass")


def tied(dim: int, u: float, rng: np.random.Generator) -> tuple[Model, Inputs]:
    """Return particles at random, and a cable along three of them, in a line: .5 m long to the bit, as at rest."""
    x = 0.2 + 0.6 * rng.random((30, dim))
    x[list(ROUTE)] = 0.5
    x[list(ROUTE), 0] = (0.25, 0.5, 0.75)
    cable = Acting.of(Cable(body="b", route=x[list(ROUTE)].tolist(), stiffness=STIFFNESS), np.array(ROUTE), x)
    model, inputs = world(
        x, size=[1.0] * dim, dx=0.1, dt=4e-3, substeps=1, controls=1, mass=rng.uniform(1, 2, 30), volume=1e-3,
        actuators=(cable,), activation=np.array([[u]]), probe=rng.normal(size=(4, 30)),
    )  # fmt: skip
    inputs.strength[:] = STIFFNESS
    inputs.state.v[:] = rng.normal(size=x.shape)
    return model, inputs


def of_cable(inputs: Inputs) -> dict[str, np.ndarray]:
    """Return what a cable's force depends on, or its cotangents; views."""
    return {
        "x": inputs.state.x, "activation": inputs.activation[:, AT], "strength": inputs.strength[AT],
        "rest": inputs.rest[AT], "mass": inputs.fields.mass,
    }  # fmt: skip


def gradient(model: Model, inputs: Inputs, records_bar: Records) -> dict[str, np.ndarray]:
    """Return the engine's gradient by what a cable's force depends on."""
    _, bar = make_rollout(model, inputs, adjoint=True).gradient(lambda records, state: LossBar(records_bar))
    return of_cable(bar)


def derivative(model: Model, inputs: Inputs, records_bar: Records, kind: str, change: np.ndarray) -> float:
    """Return the exact derivative along a change, by complex step."""
    turned = copy.deepcopy(inputs)
    make_complex(turned)
    of_cable(turned)[kind][...] += 1j * TINY * change
    records, _, _ = reference.rollout(model, turned)
    pairs = [(records.x, records_bar.x), (records.v, records_bar.v), (records.C, records_bar.C)]
    return float(sum((a * b).sum() for a, b in pairs).imag / TINY)


def random_bar(model: Model, rng: np.random.Generator) -> Records:
    """Return random cotangents of positions, velocities and affine matrices after the substep."""
    bar = Records.zeros(1, 4, model.dim)
    for a in (bar.x, bar.v, bar.C):
        a[1] = rng.normal(size=a[1].shape)
    return bar


@DIM
@pytest.mark.parametrize("kind", WANTED)
@pytest.mark.parametrize(("u", "taut"), [(1.2, False), (0.8, True), (0.1, True), (-0.3, True)])
def test_away_from_the_kinks(dim, kind, u, taut, rng):
    model, inputs = tied(dim, u, rng)
    bar = random_bar(model, rng)
    found = gradient(model, inputs, bar)
    change = rng.normal(size=found[kind].shape)
    want = derivative(model, inputs, bar, kind, change)
    assert (found[kind] * change).sum() == pytest.approx(want, rel=DOT_PRODUCT, abs=0)
    if kind in ("activation", "strength", "rest"):
        assert (want != 0) == (taut and (u > 0 or kind == "strength"))


@DIM
@pytest.mark.parametrize("kind", WANTED)
@pytest.mark.parametrize(("u", "side"), [(1.0, -1), (0.0, 1)], ids=["just taut", "just reeled in"])
def test_at_a_kink_the_derivative_is_that_of_its_steeper_side(dim, kind, u, side, rng):
    """Just taut: as if it pulled. Just reeled in: as if there were some cable left to reel in."""
    model, inputs = tied(dim, u, rng)
    bar = random_bar(model, rng)
    found = gradient(model, inputs, bar)
    change = rng.normal(size=found[kind].shape)
    beside, beyond = copy.deepcopy(inputs), copy.deepcopy(inputs)
    of_cable(beside)["activation"][...] += side * BESIDE
    of_cable(beyond)["activation"][...] -= side * BESIDE
    want, other = (derivative(model, at, bar, kind, change) for at in (beside, beyond))
    assert (found[kind] * change).sum() == pytest.approx(want, rel=1e-8, abs=1e-9)
    if kind == "activation" or (kind == "x" and u == 1.0):
        assert abs(other - want) > 1e-5 * abs(want)


@DIM
def test_just_taut_nothing_pulls(dim, rng):
    model, inputs = tied(dim, 1.0, rng)
    slack = copy.deepcopy(inputs)
    slack.strength[:] = 0.0
    last = [make_rollout(model, given) for given in (inputs, slack)]
    for rollout in last:
        rollout.run()
    np.testing.assert_array_equal(last[0].final, last[1].final)


# --- a given tension -------------------------------------------------------------------------------------------

LAST = slice(4, 5)
"""Where a cable with a given tension stands: after one of each other kind."""


def hauled(dim: int, u: float, rng: np.random.Generator) -> tuple[Model, Inputs]:
    """Return the particles of `tied`, and a cable with a tension along three of them, bent by a few degrees."""
    x = 0.2 + 0.6 * rng.random((30, dim))
    cable = Acting.of(Cable(body="b", route=x[list(ROUTE)].tolist(), tension=2.0), np.array(ROUTE), x)
    model, inputs = world(
        x, size=[1.0] * dim, dx=0.1, dt=4e-3, substeps=1, controls=1, mass=rng.uniform(1, 2, 30), volume=1e-3,
        actuators=(cable,), activation=np.array([[u]]), probe=rng.normal(size=(4, 30)),
    )  # fmt: skip
    inputs.strength[:] = 2.0
    return model, inputs


def of_tension(inputs: Inputs) -> dict[str, np.ndarray]:
    """Return what the force depends on, or its cotangents; views."""
    return {
        "x": inputs.state.x, "activation": inputs.activation[:, LAST], "strength": inputs.strength[LAST],
        "mass": inputs.fields.mass,
    }  # fmt: skip


@DIM
@pytest.mark.parametrize("kind", ["x", "activation", "strength", "mass"])
@pytest.mark.parametrize(("u", "beside"), [(0.7, 0.7), (1e-6, 1e-6), (-0.2, -0.2), (0.0, BESIDE)])
def test_a_tension_on_both_sides_of_slack(dim, kind, u, beside, rng):
    """At the kink, u = 0, the derivative is that of a cable that pulls."""
    model, inputs = hauled(dim, u, rng)
    inputs.state.v[:] = rng.normal(size=inputs.state.v.shape)
    bar = random_bar(model, rng)
    _, full = make_rollout(model, inputs, adjoint=True).gradient(lambda records, state: LossBar(bar))
    found = of_tension(full)[kind]
    change = rng.normal(size=found.shape)
    turned = copy.deepcopy(inputs)
    turned.activation[:, LAST] = beside
    make_complex(turned)
    of_tension(turned)[kind][...] += 1j * TINY * change
    records, _, _ = reference.rollout(model, turned)
    pairs = [(records.x, bar.x), (records.v, bar.v), (records.C, bar.C)]
    want = float(sum((a * b).sum() for a, b in pairs).imag / TINY)
    assert (found * change).sum() == pytest.approx(want, rel=DOT_PRODUCT, abs=1e-11)
    if kind == "activation":
        assert (want != 0) == (u >= 0)


# --- limits and rates -------------------------------------------------------------------------------------------

LOW, HIGH, CHANGE = np.array([0.0]), np.array([1.0]), np.array([0.2])
STEP = 1e-6


def held(wanted: float, previous: float | None) -> tuple[float, float, float]:
    """Return the activation given, and its derivatives by what is wanted and by the one before; None: no rate."""
    before, change = (0.0, np.array([np.inf])) if previous is None else (previous, CHANGE)
    return tuple(float(a[0]) for a in within_limits(np.array([wanted]), np.array([before]), LOW, HIGH, change))


def sides(wanted: float, previous: float | None, *, by_previous: bool = False) -> tuple[float, float]:
    """Return the derivatives from below and from above, by differences."""
    here = held(wanted, previous)[0]
    found = []
    for h in (-STEP, STEP):
        there = (wanted, previous + h) if by_previous else (wanted + h, previous)
        found.append(round((held(*there)[0] - here) / h, 6))
    return found[0], found[1]


@pytest.mark.parametrize(
    ("wanted", "previous", "given"),
    [
        (0.4, None, 0.4), (1.3, None, 1.0), (-0.2, None, 0.0),
        (0.4, 0.3, 0.4), (0.9, 0.3, 0.5), (0.1, 0.5, 0.3), (0.45, 0.5, 0.45),
        (1.3, 0.95, 1.0), (1.3, 0.6, 0.8), (-0.5, 0.1, 0.0), (-0.5, 0.7, 0.5),
    ],
)  # fmt: skip
def test_activations_within_limits_and_rates(wanted, previous, given):
    """Away from kinks both derivatives are those of differences, from either side."""
    found, by_wanted, by_previous = held(wanted, previous)
    assert found == pytest.approx(given, abs=1e-15)
    assert sides(wanted, previous) == (by_wanted, by_wanted)
    if previous is not None:
        assert sides(wanted, previous, by_previous=True) == (by_previous, by_previous)
    else:
        assert by_previous == 0.0


@pytest.mark.parametrize(
    ("wanted", "previous"),
    [(0.0, None), (1.0, None), (0.0, 0.1), (1.0, 0.9), (0.75, 0.55), (0.25, 0.45)],
    ids=["low", "high", "low late", "high late", "rising", "falling"],
)
def test_at_a_limit_the_derivative_is_that_of_the_inside(wanted, previous):
    if previous in (0.55, 0.45):  # at the rate to the bit
        wanted = previous + CHANGE[0] if wanted > previous else previous - CHANGE[0]
    found, by_wanted, by_previous = held(wanted, previous)
    assert found == wanted
    below, above = sides(wanted, previous)
    assert {below, above} == {0.0, 1.0}
    assert (by_wanted, by_previous) == (1.0, 0.0)


def test_an_optimizer_finds_its_way_back_from_a_limit_and_not_from_beyond():
    assert held(1.0, None)[1] == 1.0
    assert held(np.nextafter(1.0, 2.0), None)[1] == 0.0
