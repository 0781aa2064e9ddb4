"""A loss of one's own in Python: its gradient, in NumPy and other packages, and what it refuses."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
import yaml
from tiny_beam import BEAM, NU, E

import cqrun
from cqrun.errors import UsageError

MEASURE = {
    "tip": {"displacement": {"region": {"box": {"corner": [0.18, 0.2], "size": [0.04, 0.04]}}}},
    "bend": {"rotation": {}},
    "held": {"reaction": {"boundary": "clamp"}},
    "pull": {"cable_tension": {"cable": "pull"}},
    "stored": {"elastic_energy": {}},
}
VISCOSITY = "bodies.beam.material.viscosity.shear"
STIFFNESS = "actuators.pull.cable.stiffness"


def scene(**changes: Any) -> dict[str, Any]:
    data = yaml.safe_load(BEAM)
    route = [[0.05, 0.235], [0.21, 0.235]]
    data["actuators"] = {"pull": {"cable": {"body": "beam", "route": route, "stiffness": 50.0}}}
    data["activation"] = {"signals": {"pull": [0.9, 0.8]}}
    data["measure"] = MEASURE
    return data | changes


@pytest.fixture(scope="module")
def problem():
    return cqrun.load(scene())


def slope(value: Any, at: float, step: float) -> float:
    """Return the derivative by a central difference of order 8."""
    weights = ((1, 4 / 5), (2, -1 / 5), (3, 4 / 105), (4, -1 / 280))
    return sum(w * (value(at + k * step) - value(at - k * step)) for k, w in weights) / step


def miss(tip, bend, pull, stored, held, activation):
    """Return a loss of all kinds of quantities, and its derivatives."""
    force = held[1:, 1]
    value = 1e4 * (tip[-1] ** 2).sum() + bend[:, 0].mean() + 0.1 * pull.sum() + stored[-1, 0] + 1e-3 * force.sum()
    bars = {name: np.zeros(of.shape) for name, of in
            (("tip", tip), ("bend", bend), ("pull", pull), ("stored", stored), ("held", held))}  # fmt: skip
    bars["tip"][-1] = 2e4 * tip[-1]
    bars["bend"][:] = 1.0 / len(bend)
    bars["pull"][:] = 0.1
    bars["stored"][-1] = 1.0
    bars["held"][1:, 1] = 1e-3
    return value + (activation**2).sum(), bars | {"activation": 2.0 * activation}


@pytest.mark.parametrize("path", [E, STIFFNESS, "bodies.beam.material.density", "activation.signals.pull.0"])
def test_gradient_is_that_of_the_function_through_the_whole_motion(problem, path):
    loss = problem.loss(miss)
    at = {E: 5.0e4, STIFFNESS: 50.0, "bodies.beam.material.density": 1000.0, "activation.signals.pull.0": 0.9}[path]
    value, gradient = loss.value_and_grad({path: at})
    assert value == pytest.approx(loss({path: at}), rel=1e-14)
    expected = slope(lambda x: loss({path: x}), at, 1e-3 * at)
    assert gradient[path] == pytest.approx(expected, rel=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("path", [E, VISCOSITY, "bodies.beam.material.density"])
def test_gradient_of_what_viscosity_dissipates_is_that_of_the_motion(path):
    data = scene(measure={"lost": {"dissipated_energy": {}}})
    data["bodies"]["beam"]["material"]["viscosity"] = {"shear": 50.0}
    weight = np.arange(11.0)[:, None]
    loss = cqrun.load(data).loss(lambda lost: ((weight * lost).sum(), {"lost": weight}))
    at = {E: 5.0e4, VISCOSITY: 50.0, "bodies.beam.material.density": 1000.0}[path]
    expected = slope(lambda x: loss({path: x}), at, 1e-3 * at)
    assert loss.value_and_grad({path: at})[1][path] == pytest.approx(expected, rel=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("path", [E, NU, "bodies.beam.material.density", "bodies.beam.shape.box.size.1"])
def test_gradient_of_stress_and_energy_of_averaged_volumes_is_that_of_the_motion(path):
    """Also by the shape, on which the corners' shares of the particles depend."""
    root = {"region": {"box": {"corner": [0.04, 0.2], "size": [0.04, 0.02]}}}
    data = scene(measure={"root": {"stress": root}, "stored": {"elastic_energy": root}})
    data["bodies"]["beam"]["material"]["elastic"]["neo_hookean"]["poissons_ratio"] = 0.49
    by_root, by_stored = 1e-3 * np.arange(33.0).reshape(11, 3), np.arange(11.0)[:, None]

    def measured(root, stored):
        return (by_root * root).sum() + (by_stored * stored).sum(), {"root": by_root, "stored": by_stored}

    loss = cqrun.load(data).loss(measured)
    at = {E: 5.0e4, NU: 0.49, "bodies.beam.material.density": 1000.0, "bodies.beam.shape.box.size.1": 0.04}[path]
    expected = slope(lambda x: loss({path: x}), at, 3e-5 * at)
    assert loss.value_and_grad({path: at})[1][path] == pytest.approx(expected, rel=1e-7)


def test_vjp_of_all_particles_is_the_transpose_of_the_motion(problem):
    rng, base = np.random.default_rng(2), problem.simulate()
    x_bar, v_bar = rng.normal(size=base.x.shape), rng.normal(size=base.v.shape)

    def product(young: float) -> float:
        motion = problem.simulate({E: young})
        return float((x_bar * motion.x).sum() + (v_bar * motion.v).sum())

    gradient = problem.vjp({E: 5.0e4}, x_bar=x_bar, v_bar=v_bar)
    assert gradient[E] == pytest.approx(slope(product, 5.0e4, 50.0), rel=1e-7)


def test_a_motion_has_the_measured_quantities(problem):
    motion = problem.simulate()
    assert set(motion.measured) == set(MEASURE)
    assert motion.measured["tip"].shape == (11, 2)
    assert np.isnan(motion.measured["held"][0]).all()
    assert motion.measured["pull"][-1, 0] > 0


def test_a_controller_has_its_gradient_too():
    data = scene(controller={"linear_tanh": {}}, observers={"seen": {"measured": {"quantity": "bend"}}},
                 objective={"far": {"measured": {"quantity": "tip", "target": [0.0, 0.0]}}})  # fmt: skip
    del data["activation"]
    problem = cqrun.load(data)
    loss = problem.loss(lambda tip: ((tip[-1] ** 2).sum(), {"tip": np.eye(len(tip))[:, [-1]] * 2.0 * tip[-1]}))
    value, gradient = loss.value_and_grad()
    wanted, expected, _ = problem.value_and_grad()
    assert value == pytest.approx(wanted, rel=1e-12)
    for path, bar in expected.items():
        assert gradient[path] == pytest.approx(bar, rel=1e-10)


@pytest.mark.parametrize("backend", ["torch", "jax"])
def test_functions_of_other_packages_have_the_same_gradient(problem, backend):
    pytest.importorskip(backend)
    plain = problem.loss(lambda tip: ((tip**2).sum(), {"tip": 2.0 * tip}))
    other = problem.loss(lambda tip, time: (tip**2).sum(), backend=backend)
    expected, found = plain.value_and_grad({E: 5.0e4}), other.value_and_grad({E: 5.0e4})
    assert found[0] == pytest.approx(expected[0], rel=1e-13)
    assert found[1][E] == pytest.approx(expected[1][E], rel=1e-12)
    assert other() == pytest.approx(expected[0], rel=1e-13)


def test_arguments_may_have_other_names(problem):
    loss = problem.loss(lambda a, b: (a.sum() + b.sum(), {"x": np.ones(a.shape)}), of=["x", "time"])
    motion = problem.simulate()
    assert loss() == pytest.approx(motion.x.sum() + motion.time.sum())
    assert repr(loss) == "<loss of x, time>"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda p: p.loss(lambda tp: 0.0), r"no 'tp' in a motion .did you mean 'tip'.*quantities of `measure`: tip"),
        (lambda p: p.loss(lambda tip: 0.0, backend="tensorflow"), "no backend 'tensorflow'"),
        (lambda p: p.loss(lambda: 0.0), "does not name its arguments"),
        (lambda p: p.loss(lambda tip: 0.0)(), r"must return .loss, .name: derivative.., not 0"),
        (lambda p: p.loss(lambda tip: (np.nan, {}))(), "returned nan; a loss must be finite"),
        (lambda p: p.loss(lambda tip: (0.0, {"x": tip}))(), "a derivative by 'x', which it does not take"),
        (lambda p: p.loss(lambda tip: (0.0, {"tip": tip[1:]})).value_and_grad(), r"shape \(10, 2\); the array has"),
        (lambda p: p.vjp(x_bar=np.zeros(3)), r"vjp: x has the shape \(3,\); its array has \(11, 80, 2\)"),
        (lambda p: p.vjp(), "vjp takes derivatives as x_bar"),
        (lambda p: p.vjp(tip_bar=np.full((11, 2), np.nan)), r"the derivative by 'tip' is not finite at .0, 0."),
        (lambda p: p.loss(lambda tip: (0.0, {"tip": 1j * tip}))(), "no real numbers: it is of the type complex128"),
        (lambda p: p.loss(lambda tip: (tip, {}))(), "must return a single real number as the loss"),
        (lambda p: p.loss(3), "loss: 3 is no function"),
        (lambda p: p.loss(lambda tip: 0.0, of=["tip", "x"]), "does not take 2 arrays: too many positional arguments"),
        (lambda p: p.vjp(x=np.zeros(3)), "not x"),
    ],
)
def test_mistakes_are_explained(problem, make, message):
    with pytest.raises(UsageError, match=message):
        make(problem)


def test_data_that_another_yaml_reader_made_has_the_same_numbers():
    """PyYAML reads 5.0e4 as text, because YAML 1.1 wants a sign in the exponent."""
    data = yaml.safe_load(BEAM)
    assert data["bodies"]["beam"]["material"]["elastic"]["neo_hookean"]["youngs_modulus"] == "5.0e4"
    from_data, from_text = cqrun.load(data).scene, cqrun.load(BEAM).scene
    assert from_data.model_dump() == from_text.model_dump()


def test_a_notebook_shows_a_problem_with_its_parameters():
    data = scene(title="<b>beam</b>", unknowns={E: {"bounds": [3.0e4, 9.0e4]}}, controller={"linear_tanh": {}},
                 observers={"seen": {"measured": {"quantity": "tip"}}})  # fmt: skip
    del data["activation"]
    problem = cqrun.load(data)
    page = problem._repr_html_()
    assert "&lt;b&gt;beam&lt;/b&gt;; 80 particles, 10 control steps, 3 parameters" in page
    assert f"<td><code>{E}</code></td><td>50000</td><td>Pa</td>" in page
    assert "array of shape (1, 2)" in page
    assert repr(problem) == "<cqrun problem: <b>beam</b>; 80 particles, 10 control steps, 3 parameters>"


def test_a_loss_may_be_used_by_several_threads_at_once():
    problem = cqrun.load(scene(), threads=1)
    loss = problem.loss(lambda tip: ((tip**2).sum(), {"tip": 2.0 * tip}))
    params = [{E: 5.0e4 + 100.0 * k} if k % 2 else {STIFFNESS: 50.0 + k} for k in range(8)]
    one_by_one = [loss.value_and_grad(each) for each in params]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(loss.value_and_grad, params)) == one_by_one


def test_a_quantity_may_be_called_particles():
    problem = cqrun.load(scene(measure={"particles": {"position": {}}}))
    motion = problem.simulate()
    bars = lambda particles, x: {"particles": np.ones(particles.shape), "x": np.ones(x.shape)}  # noqa: E731
    loss = problem.loss(lambda particles, x: (particles.sum() + x.sum(), bars(particles, x)))
    assert loss() == pytest.approx(motion.measured["particles"].sum() + motion.x.sum(), rel=1e-12)


def test_a_function_that_changes_its_arrays_changes_nothing_else(problem):
    def careless(tip):
        bar = 2.0 * tip
        value = (tip**2).sum()
        tip[:] = 0.0
        return value, {"tip": bar}

    plain = problem.loss(lambda tip: ((tip**2).sum(), {"tip": 2.0 * tip}))
    assert problem.loss(careless).value_and_grad({E: 5.0e4}) == plain.value_and_grad({E: 5.0e4})
    assert problem.loss(careless, of="tip")() == plain()


def test_a_text_that_looks_like_a_number_stays_a_text_where_a_text_belongs():
    data = yaml.safe_load(BEAM) | {"title": "1e4"}
    data["world"]["gravity"] = [0, "-9.81e0"]
    read = cqrun.load(data).scene
    assert (read.title, read.world.gravity) == ("1e4", [0.0, -9.81])
