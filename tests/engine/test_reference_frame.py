"""The reference frame: its motion against the equations in plain NumPy, its adjoint, and what it conserves."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import total_lagrangian
from little_worlds import STRESSES, TERMS
from rich_scene import KINDS, arrays, direction, moved, parts, product, random_records, random_state, rich

from cqrun.boundaries.slip import Slip
from cqrun.boundaries.sticky import Sticky
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import GroupModel, LossBar, Records

DOT_PRODUCT = 1e-9
TINY = 1e-30
ELASTIC = (TERMS[0], TERMS[1], TERMS[3])
"""The terms that do not depend on rates."""

SLOW = {"viscosity.shear", "viscosity.bulk"}
UNKNOWN = {"x", "F", "friction"}
"""What a rollout in this frame has no gradient of."""


def held(dim, *, viscous=True, seed=0, **options):
    """Return a rich model in the reference frame, held by slipping and clamped nodes, and its inputs at rest."""
    model, inputs = rich(dim, seed=seed, **options)
    walls = [c if isinstance(c.spec, (Slip, Sticky)) else replace(c, nodes=np.zeros_like(c.nodes))
             for c in model.conditions]  # fmt: skip
    inputs.state.F[...] = np.eye(dim)
    if not viscous:
        inputs.terms[0][2][...] = 0.0
    return replace(model, conditions=tuple(walls), frame="reference"), inputs


def compiled(model, inputs, viscous):
    """Return the engine's model and inputs: without the viscous term, a rollout runs backwards."""
    if viscous:
        return model, inputs
    given = copy.copy(inputs)
    given.terms = [[inputs.terms[0][k] for k in (0, 1, 3)]]
    return replace(model, groups=(GroupModel((0, 1), ELASTIC, STRESSES),)), given


def completed(bar, viscous):
    """Return the cotangent of inputs with a zero in place of the viscous term."""
    if not viscous:
        first, second, last = bar.terms[0]
        bar.terms = [[first, second, np.zeros_like(first), last]]
    return bar


@pytest.fixture(scope="module", params=[(2, True), (2, False), (3, True), (3, False)],
                ids=["2D", "2D reversed", "3D", "3D reversed"])  # fmt: skip
def case(request):
    """Return a model, its inputs, cotangents, the rollout and its gradient."""
    dim, viscous = request.param
    rng = np.random.default_rng(7)
    model, inputs = held(dim, viscous=viscous)
    records_bar = random_records(Records.zeros(model.n_controls, 3, dim), rng)
    state_bar = random_state(inputs.state, rng)
    rollout = make_rollout(*compiled(model, inputs, viscous), adjoint=True)
    records, bar = rollout.gradient(lambda records, state: LossBar(records_bar, state_bar))
    assert rollout.reversible == (not viscous)
    return model, inputs, records_bar, state_bar, rollout, records, completed(bar, viscous), viscous


def test_the_motion_is_that_of_the_equations(case):
    model, inputs, _, _, rollout, records, _, _ = case
    expected, last = total_lagrangian.rollout(model, inputs)
    for got, want in zip(parts(records), parts(expected), strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-11 * np.abs(want).max())
    for got, want in zip(parts(rollout.unpack(rollout.final, 0)), parts(last), strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-10 * np.abs(want).max())


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in UNKNOWN])
def test_dot_product(case, kind, rng):
    model, inputs, records_bar, state_bar, _, _, bar, viscous = case
    if kind in SLOW and not viscous:
        pytest.skip("this material has no viscosity")
    change = direction(inputs, kind, rng)
    records, last = total_lagrangian.rollout(model, moved(inputs, kind, 1j * TINY * change))
    forward = (product(records, records_bar) + product(last, state_bar)).imag / TINY
    backward = (arrays(bar)[KINDS.index(kind)] * change).sum()
    assert abs(forward) > 0
    assert backward == pytest.approx(forward, rel=DOT_PRODUCT)
