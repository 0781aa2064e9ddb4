"""A material with a history (tests/relaxation.py) in the reference frame: its motion, its adjoint, kept states."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import total_lagrangian
from little_worlds import STRESSES, Extra, needs_jit
from plugin_sandbox import sandbox
from rich_scene import (
    COUNTS,
    KINDS,
    arrays,
    direction,
    make_complex,
    moved,
    parts,
    product,
    random_records,
    random_state,
)
from test_contact import touched
from test_reference_frame import DOT_PRODUCT, ELASTIC, SHEAR, SLOW, TINY, UNKNOWN, carried, held

from cqrun.build.model import build
from cqrun.engine.blocks import SORT_EVERY
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import GroupModel, LossBar, Records
from cqrun.engine.statics.equilibrium import Equilibrium
from cqrun.errors import SceneError
from cqrun.fitting.at_rest import _unsuited
from cqrun.jobs.rest import REST
from cqrun.materials.term import MaterialTerm
from cqrun.plugin.registry import plugins
from cqrun.scene.load import load_scene
from cqrun.scene.plugin_files import plugins_allowed

FILE = Path(__file__).parents[1] / "relaxation.py"
STRAIN = "relaxation.strain"
OWN = ("modulus", "time", STRAIN)
"""What the term adds to the inputs."""


@pytest.fixture(scope="module", autouse=True)
def _loaded() -> Iterator[None]:
    """Load the plug-in file; kernels that know it are cached apart from all others."""
    with sandbox(), plugins_allowed():
        load_scene(SCENE)
        yield


def extra(dim):
    """Return the term, with random parameters."""
    spec, rng = plugins("material_term")["relaxation"](modulus=1.0, time=1.0), np.random.default_rng(11)
    fields = tuple(field._replace(name=STRAIN) for field in spec.history(dim))
    theta = np.array([rng.uniform(2, 3, sum(COUNTS)), rng.uniform(0.01, 0.03, sum(COUNTS))])
    return Extra(spec.kernel_term, theta, fields)


def relaxing(dim, *, viscous=True, averaged=False, make=held, **options):
    """Return a rich model of the reference frame with the term, and its inputs."""
    model, inputs, *more = make(dim, viscous=viscous, extra=extra(dim), **options)
    inputs.shaped = True
    groups = (replace(model.groups[0], shear=(*SHEAR, MaterialTerm.shear_modulus)),)
    return replace(model, groups=groups, averaged=averaged), inputs, *more


def compiled(model, inputs, viscous):
    """Return the engine's model and inputs: without the viscous term, no stress depends on rates."""
    if viscous:
        return model, inputs
    given, group = copy.copy(inputs), model.groups[0]
    given.terms = [[inputs.terms[0][k] for k in (0, 1, 3, 4)]]
    terms, history = (*ELASTIC, group.kernel_terms[4]), ((), (), (), group.history[4])
    shear = tuple(group.shear[k] for k in (0, 1, 3, 4))
    return replace(model, groups=(GroupModel((0, 1), terms, STRESSES, history, shear),)), given


def completed(bar, viscous):
    """Return the cotangent of inputs with a zero in place of the viscous term."""
    if not viscous:
        bar.terms[0].insert(2, np.zeros_like(bar.terms[0][0]))
    return bar


def values(inputs):
    """Return everything that a rollout depends on, by kind."""
    own = (*inputs.terms[0][4], inputs.state.history[STRAIN])
    return dict(zip(KINDS, arrays(inputs), strict=True)) | dict(zip(OWN, own, strict=True))


def pushed(inputs, kind, change):
    """Return inputs with one kind moved, complex where the change is."""
    if kind not in OWN:
        return moved(inputs, kind, change)
    other = copy.deepcopy(inputs)
    if np.iscomplexobj(change):
        make_complex(other)
    values(other)[kind][...] += change
    return other


def way(inputs, kind, rng):
    """Return a random direction of one kind of input."""
    if kind not in OWN:
        return direction(inputs, kind, rng)
    value = values(inputs)[kind]
    return rng.normal(size=value.shape) * value


def bars_of(model, inputs):
    """Return random cotangents of the results."""
    rng = np.random.default_rng(7)
    records_bar = random_records(Records.zeros(model.n_controls, 3, model.dim, model.layout.history), rng)
    return LossBar(records_bar, random_state(inputs.state, rng))


def gradient(model, inputs, viscous, threads=1):
    """Return the rollout, random cotangents, the records and the gradient."""
    bars = bars_of(model, inputs)
    rollout = make_rollout(*compiled(model, inputs, viscous), threads=threads, adjoint=True)
    assert rollout.threads == threads
    records, bar = rollout.gradient(lambda records, state: bars)
    return rollout, bars, records, completed(bar, viscous)


CASES = {"2D": (2, True, False), "2D means": (2, False, True), "3D": (3, False, False)}
"""Name -> dimension, whether the material is viscous, and whether volumes are averaged."""

PLANE = {name: CASES[name] for name in ("2D", "2D means")}


@pytest.fixture(scope="module", params=CASES.values(), ids=CASES)
def case(request):
    """Return a model, its inputs, the rollout, cotangents, records, the gradient, and whether it is viscous."""
    dim, viscous, averaged = request.param
    model, inputs = relaxing(dim, viscous=viscous, averaged=averaged)
    return model, inputs, *gradient(model, inputs, viscous), viscous


def test_the_motion_is_that_of_the_equations(case):
    model, inputs, rollout, _, records, _, _ = case
    expected, last = total_lagrangian.rollout(model, inputs)
    for got, want in zip(parts(records), parts(expected), strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-11 * np.abs(want).max())
    for got, want in zip(parts(rollout.unpack(rollout.final, 0)), parts(last), strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-10 * np.abs(want).max())
    assert np.abs(records.history[STRAIN][-1] - records.history[STRAIN][0]).max() > 1e-3


def dot_product(model, inputs, kind, bars, bar, rng):
    """Compare the gradient by one kind of input with the derivative of the equations."""
    change = way(inputs, kind, rng)
    records, last = total_lagrangian.rollout(model, pushed(inputs, kind, 1j * TINY * change))
    forward = (product(records, bars.records) + product(last, bars.final)).imag / TINY
    assert abs(forward) > 0
    assert (values(bar)[kind] * change).sum() == pytest.approx(forward, rel=DOT_PRODUCT)


@pytest.mark.parametrize("kind", [*OWN, *(kind for kind in KINDS if kind not in UNKNOWN)])
def test_dot_product(case, kind, rng):
    model, inputs, _, bars, _, bar, viscous = case
    if kind in SLOW and not viscous:
        pytest.skip("this material has no viscosity")
    dot_product(model, inputs, kind, bars, bar, rng)


def test_reactions_have_a_gradient_beside_a_history(rng):
    """The impulses in a kept state stand before the histories."""
    model, inputs = relaxing(2, viscous=False)
    model = replace(model, reactions=("sticky", "slip"))
    bar = Records.zeros(model.n_controls, 3, 2, model.layout.history)
    bar.held = {name: rng.normal(size=(model.n_controls + 1, 3)) for name in model.reactions}
    rollout = make_rollout(*compiled(model, inputs, viscous=False), adjoint=True)
    _, inputs_bar = rollout.gradient(lambda records, state: LossBar(bar))
    found = values(completed(inputs_bar, viscous=False))
    for kind in (*OWN, "x", "v", "mass", "neo_hookean.E"):
        change = way(inputs, kind, rng)
        records, _ = total_lagrangian.rollout(model, pushed(inputs, kind, 1j * TINY * change))
        forward = sum((records.held[name][1:] * rows[1:]).sum() for name, rows in bar.held.items()).imag / TINY
        assert (found[kind] * change).sum() == pytest.approx(forward, rel=DOT_PRODUCT), kind


def test_a_run_is_not_reversed(case):
    rollout = case[2]
    assert not rollout.reversible
    assert rollout.kept_because == "stresses have a history"
    counted = replace(rollout.model, n_nodes=rollout.rest.patches.n_nodes).state_bytes
    assert counted == rollout.state_bytes == rollout.start.nbytes


@needs_jit
@pytest.mark.parametrize("kind", [*OWN, "v", "mass", "neo_hookean.E"])
@pytest.mark.parametrize(("dim", "viscous", "averaged"), PLANE.values(), ids=PLANE)
def test_taylor_remainder_is_of_second_order(dim, viscous, averaged, kind, rng):
    model, inputs = relaxing(dim, viscous=viscous, averaged=averaged, substeps=8, controls=3, seed=4)
    _, bars, _, bar = gradient(model, inputs, viscous)

    def loss(given):
        seen = {}
        records = make_rollout(*compiled(model, given, viscous)).run(observe=seen.__setitem__)
        return float(product(records, bars.records) + product(seen[model.n_controls], bars.final))

    change, here = way(inputs, kind, rng), loss(inputs)
    slope = float((values(bar)[kind] * change).sum())
    steps = 2.0 ** -np.arange(3, 11)
    remainders = np.array([abs(loss(pushed(inputs, kind, h * change)) - here - h * slope) for h in steps])
    assert np.median(np.log2(remainders[:-1] / remainders[1:])[-4:]) >= 1.9, remainders


@needs_jit
@pytest.mark.parametrize(
    ("name", "precision"),
    [("2D", np.float64), ("2D means", np.float64), ("3D", np.float64), ("2D means", np.float32)],
)
def test_any_number_of_threads_gives_the_same_bits(name, precision):
    dim, viscous, averaged = CASES[name]
    model, inputs = relaxing(dim, viscous=viscous, averaged=averaged, real=precision)
    found = []
    for threads in (1, 2, 3):
        rollout, _, records, bar = gradient(model, inputs, viscous, threads)
        last = rollout.unpack(rollout.final, 0)
        found.append([a.tobytes() for a in (*parts(records), *parts(last), *values(bar).values())])
    assert found[0] == found[1] == found[2]


@needs_jit
@pytest.mark.parametrize(("dim", "viscous", "averaged"), PLANE.values(), ids=PLANE)
def test_states_that_are_not_kept_are_computed_again_to_the_same_bits(dim, viscous, averaged):
    """Chunks end with control steps here: some cotangents are summed over a control step, and a chunk splits it."""
    model, inputs = relaxing(dim, viscous=viscous, averaged=averaged, substeps=SORT_EVERY)
    whole, _, records, bar = gradient(model, inputs, viscous)
    little = replace(model, memory_budget=12 * whole.state_bytes)
    short, _, again, bar_again = gradient(little, inputs, viscous, threads=2)
    assert whole.plan.n_chunks == 1 < short.plan.n_chunks
    for a, b in zip(
        (*parts(records), *values(bar).values()), (*parts(again), *values(bar_again).values()), strict=True
    ):
        np.testing.assert_array_equal(a, b)


@needs_jit
def test_in_float32_it_is_nearly_the_same():
    dim, viscous, averaged = CASES["2D means"]
    model, inputs = relaxing(dim, viscous=viscous, averaged=averaged)
    _, _, records, bar = gradient(model, inputs, viscous)
    _, _, coarse, bar_coarse = gradient(replace(model, real=np.float32), inputs, viscous)
    for a, b in zip(parts(coarse), parts(records), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=2e-4 * np.abs(b).max())
    for kind in OWN:
        want = values(bar)[kind]
        np.testing.assert_allclose(values(bar_coarse)[kind], want, rtol=0, atol=5e-3 * np.abs(want).max())


def test_kept_states_are_those_of_a_run(case):
    """With and without `keep`, and with a stop between: a history is part of the state, not of the rollout."""
    model, inputs, _, _, _, _, viscous = case
    rollout = make_rollout(*compiled(model, inputs, viscous))
    kept = np.stack([rollout.start] * (model.n_steps + 1))
    rollout.advance(0, model.n_steps, kept, keep=True)
    states = rollout.start[None].copy()
    for step in range(model.n_steps):
        rollout.unpack(kept[model.n_steps - step], 0)
        rollout.advance(step, step + 1, states, keep=False)
        np.testing.assert_array_equal(states[0], kept[step + 1])


# --- beside what else moves nodes -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", OWN)
def test_dot_product_where_bodies_touch(kind, rng):
    """A state has springs of contact and histories."""
    model, inputs = relaxing(2, make=touched)
    _, bars, records, bar = gradient(model, inputs, True)
    assert model.n_springs > 0
    expected, _ = total_lagrangian.rollout(model, inputs)
    for got, want in zip(parts(records), parts(expected), strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-11 * np.abs(want).max())
    dot_product(model, inputs, kind, bars, bar, rng)


def split(model, inputs):
    """Return the model with two groups, of which only the second has the term, and its inputs."""
    group, n, given = model.groups[0], COUNTS[0], copy.copy(inputs)
    plain = GroupModel((0,), group.kernel_terms[:4], STRESSES, shear=SHEAR)
    first, second = ([theta[:, part] for theta in inputs.terms[0]] for part in (slice(0, n), slice(n, None)))
    given.terms = [first[:4], second]
    return replace(model, groups=(plain, replace(group, bodies=(1,)))), given


@pytest.fixture(scope="module")
def two_groups():
    """Return a model with a clamp that moves and two groups, its inputs, the clamp, cotangents, and the gradient."""
    model, inputs, k = relaxing(2, make=carried)
    model, given = split(model, inputs)
    bars = bars_of(model, inputs)
    rollout = make_rollout(model, given, adjoint=True)
    _, bar = rollout.gradient(lambda records, state: bars)
    return model, given, k, bars, bar, rollout


def test_a_body_without_the_term_keeps_its_numbers(two_groups):
    """In any state, the numbers of a body without the term are those of its start."""
    model, inputs, _, bars, bar, rollout = two_groups
    start, last = (a.history[STRAIN] for a in (inputs.state, rollout.unpack(rollout.final, 0)))
    np.testing.assert_array_equal(last[: COUNTS[0]], start[: COUNTS[0]])
    assert not np.any(last[COUNTS[0] :] == start[COUNTS[0] :])
    want = bars.records.history[STRAIN].sum(axis=0) @ model.probe.toarray() + bars.final.history[STRAIN]
    np.testing.assert_allclose(bar.state.history[STRAIN][: COUNTS[0]], want[: COUNTS[0]], rtol=1e-12)


@pytest.mark.parametrize("kind", ["time", STRAIN, "mass", "moves"])
def test_gradients_hold_beside_a_clamp_that_moves(two_groups, kind, rng):
    """By differences, because the equations in plain NumPy know no clamp that moves."""
    model, inputs, k, bars, bar, _ = two_groups

    def value(of):
        return {
            "time": of.terms[1][4][1], STRAIN: of.state.history[STRAIN], "mass": of.fields.mass, "moves": of.moves
        }[kind]  # fmt: skip

    change, ends = rng.normal(size=value(inputs).shape) * np.maximum(np.abs(value(inputs)), 1e-3), []
    if kind == "moves":
        change[np.arange(len(change)) != k] = 0.0
    for h in (-2, -1, 1, 2):
        given, seen = copy.deepcopy(inputs), {}
        value(given)[...] += h * 1e-4 * change
        records = make_rollout(model, given).run(observe=seen.__setitem__)
        ends.append(product(records, bars.records) + product(seen[model.n_controls], bars.final))
    difference = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / 12e-4
    assert (value(bar) * change).sum() == pytest.approx(difference, rel=1e-7)


# --- it has no equilibrium --------------------------------------------------------------------------------------------

SCENE = f"""\
cqrun: 1
plugins: ["{FILE}"]
world: {{size: [0.4, 0.3], dx: 0.02, gravity: [0, -9.81]}}
bodies:
  beam:
    shape: {{box: {{corner: [0.02, 0.16], size: [0.2, 0.04]}}}}
    particles_per_cell: 4
    material:
      density: 1000
      elastic: {{neo_hookean: {{youngs_modulus: 5.0e4, poissons_ratio: 0.3}}}}
      relaxation: {{modulus: 2.0e4, time: 0.05}}
boundaries:
  clamp: {{sticky: {{region: {{box: {{corner: [0, 0], size: [0.06, 0.3]}}}}}}}}
time: {{duration: 0.06, control_step: 0.01}}
"""
REFUSED = r"bodies\.beam\.material\.relaxation: the stress of `relaxation` has a history, and so no equilibrium"


def test_it_has_no_equilibrium():
    model, inputs = relaxing(2)
    with pytest.raises(ValueError, match=r"relaxation\.strain"):
        Equilibrium(model, inputs)


def test_a_scene_moves_but_does_not_rest():
    scene = load_scene(SCENE)
    assert build(scene).model.frame == "reference"
    with pytest.raises(SceneError, match=REFUSED):
        REST.prepare(scene, 1, None)
    with pytest.raises(SceneError, match=REFUSED):
        build(load_scene(SCENE + "start: equilibrium\n"))
    comparison = SimpleNamespace(spec=SimpleNamespace(name="markers_at_rest"))
    ((path, message),) = _unsuited(scene, "hangs", comparison)
    assert path == "bodies.beam.material.relaxation"
    assert "but the recording 'hangs' (`markers_at_rest`) is compared with bodies at rest" in message
