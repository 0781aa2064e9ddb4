"""Map every differentiable number of a scene to the engine's inputs, and gradients back."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cqrun.build.model import Built, build
from cqrun.engine.model import Inputs
from cqrun.errors import SceneError, UsageError
from cqrun.loads.point_force import PointForce
from cqrun.running.unknowns import make_params
from cqrun.scene.load import load_scene
from cqrun.scene.paths import leaf, leaves
from cqrun.state import MOTION

STEP = 1e-3
"""Relative step of a fourth-order difference; the map is linear or smooth in each number."""


def everything(dim: int) -> dict[str, Any]:
    """Return a scene with all kinds of loads, a wall with friction, and all kinds of terms, actuators and signals."""
    ends = [0.0] * (dim - 1)
    tip = {"box": {"corner": [0.35, *[0.2] * (dim - 1)], "size": [0.1, *[0.2] * (dim - 1)]}}
    body = {
        "shape": {"box": {"corner": [0.25] * dim, "size": [0.2] * dim}},
        "particles_per_cell": 2**dim,
        "velocity": [0.1] * dim,
        "spin": [0.3] * (1 if dim == 2 else 3),
        "groups": {"tip": tip},
        "material": {
            "density": 900.0,
            "elastic": {"fixed_corotated": {"youngs_modulus": 1.0e4, "poissons_ratio": 0.3}},
            "viscosity": {"shear": 2.0, "bulk": 3.0},
            "incompressibility": {"power": 2},
        },
        "material_of": {
            "tip": {"density": 1100, "elastic": {"fixed_corotated": {"youngs_modulus": 2e4, "poissons_ratio": 0.25}}}
        },
    }
    return {
        "cqrun": 1,
        "world": {"size": [0.8] * dim, "dx": 0.05, "gravity": [0.2, *ends[1:], -9.0], "frame": "updated"},
        "bodies": {"a": body},
        "boundaries": {"floor": {"friction": {"face": "y_min", "coefficient": 0.4}}},
        "loads": {
            "air": {"damping": {"rate": 1.5}},
            "weight": {"attached_mass": {"body": "a", "mass": 0.2, "region": "tip"}},
            "pull": {"point_force": {"body": "a", "force": [1.0, *[2.0] * (dim - 1)], "region": "tip"}},
        },
        "actuators": {
            "muscle": {"muscle": {"body": "a", "axis": [1.0, *ends], "strength": 50.0}},
            "air": {"pneumatic": {"body": "a", "region": "tip", "max_pressure": 40.0}},
            "cord": {"cable": {"body": "a", "route": [[0.27] * dim, [0.43] * dim], "stiffness": 30.0}},
            "tendon": {"cable": {"body": "a", "route": [[0.27] * dim, [0.43] * dim], "tension": 3.0}},
            "magnet": {"body_force": {"body": "a", "direction": [0.0, *[1.0] * (dim - 1)], "acceleration": 3.0}},
        },
        "activation": {
            "signals": {
                "muscle": [0.2, -0.4],
                "air": [0.5, 0.3],
                "cord": [0.9, 0.8],
                "magnet": [0.1, 0.7],
                "tendon": [0.4, 0.6],
            }
        },
        "time": {"duration": 0.04, "control_step": 0.01},
    }


@pytest.fixture(scope="module", params=[2, 3], ids=["2D", "3D"])
def built(request) -> Built:
    """Return the built scene."""
    return build(load_scene(everything(request.param)))


def flat(inputs: Inputs) -> np.ndarray:
    """Return all inputs as one vector."""
    s, f = inputs.state, inputs.fields
    parts = [s.x, s.v, s.C, s.F, f.mass, f.volume, f.damping, f.force, inputs.activation, inputs.strength,
             inputs.coefficients, inputs.weights, *(theta for group in inputs.terms for theta in group)]  # fmt: skip
    return np.concatenate([part.reshape(-1) for part in parts])


def random_bar(inputs: Inputs, rng: np.random.Generator) -> Inputs:
    """Return a random cotangent of the inputs; each part is divided by its own size."""
    bar = Inputs.zeros_like(inputs)
    for whole, like, names in ((bar.state, inputs.state, MOTION), (bar.fields, inputs.fields, vars(bar.fields))):
        for name in names:
            size = np.abs(getattr(like, name)).max(initial=0.0) or 1.0
            setattr(whole, name, rng.normal(size=getattr(like, name).shape) / size)
    bar.terms = [[rng.normal(size=a.shape) / (np.abs(a).max() or 1.0) for a in group] for group in inputs.terms]
    for name in ("activation", "strength", "coefficients", "weights"):
        value = getattr(inputs, name)
        setattr(bar, name, rng.normal(size=value.shape) / (np.abs(value).max() or 1.0))
    return bar


def test_dot_product_of_every_number(built, rng):
    """The message names a path that has no effect, or whose gradient is wrong."""
    assembly, scene = built.assembly, built.scene
    paths = [path for path in leaves(scene, differentiable=True) if assembly.reaches(path)]
    wanted = (
        "world.gravity.0", "loads.pull.point_force.force.1", "loads.weight.attached_mass.mass",
        "loads.air.damping.rate", "actuators.muscle.muscle.weight",
        "boundaries.floor.friction.coefficient", "bodies.a.velocity.1", "bodies.a.spin.0",
        "bodies.a.material_of.tip.density", "actuators.cord.cable.stiffness", "activation.signals.air.1",
        "actuators.tendon.cable.tension",
    )  # fmt: skip
    assert set(wanted) <= set(paths)
    values = {path: np.array(float(leaf(scene, path).value)) for path in paths}
    bar = random_bar(assembly.inputs(values), rng)
    gradient = assembly.gradient(values, bar)
    for path, value in values.items():
        h = STEP * (abs(float(value)) or 1.0)
        at = {k: float(flat(assembly.inputs({**values, path: value + k * h})) @ flat(bar)) for k in (-2, -1, 1, 2)}
        slope = (8 * (at[1] - at[-1]) - (at[2] - at[-2])) / (12 * h)
        assert slope != 0, path
        rounding = 1e-14 * abs(at[1]) / h
        assert abs(float(gradient[path]) - slope) <= 1e-9 * abs(slope) + rounding, path


def test_the_error_names_a_load_that_returns_no_cotangent(built, monkeypatch):
    """Only if its gradient is requested, which would otherwise silently be 0."""
    monkeypatch.setattr(PointForce, "apply_vjp", lambda self, fields, fields_bar, chosen: {"size": 0.0})
    assembly, path = built.assembly, "loads.pull.point_force.force.1"
    bar = Inputs.zeros_like(assembly.inputs({}))
    assembly.gradient({"loads.air.damping.rate": np.array(1.0)}, bar)
    message = "the load 'point_force' declares `force` differentiable, but its apply_vjp returns no cotangent of it"
    with pytest.raises(UsageError, match=message):
        assembly.gradient({path: np.array(1.0)}, bar)


@pytest.mark.parametrize("name", ["muscle.muscle", "air.pneumatic"])
def test_weights_of_an_actuators_particles(built, name, rng):
    """A weight for each particle of the body; particles outside the actuator have no effect."""
    assembly, path = built.assembly, f"actuators.{name}.weight"
    count = len(built.particles.points["a"].x)
    values = {path: rng.uniform(0.2, 1.0, count)}
    inputs = assembly.inputs(values)
    actuator = next(k for k, part in enumerate(assembly.actuation.parts) if part.path == f"actuators.{name}")
    particles = assembly.actuation.parts[actuator].model.particles
    part = built.model.weight_slices[actuator]
    np.testing.assert_array_equal(inputs.weights[part], values[path][particles])
    assert set(np.delete(inputs.weights, np.r_[part])) == {1.0}
    bar = random_bar(inputs, rng)
    gradient = assembly.gradient(values, bar)[path]
    np.testing.assert_array_equal(gradient[particles], bar.weights[part])
    assert not np.delete(gradient, particles).any()
    assert not len(assembly.inputs({}).weights)
    stress = assembly.actuation.largest_stress(values) / assembly.actuation.largest_stress({}).max()
    assert stress.max() < 1.0


def test_the_placement_of_a_muscle_can_be_a_field():
    """Its weight can be an unknown: a smooth field over the body."""
    path = "actuators.muscle.muscle.weight"
    scene = everything(2) | {"unknowns": {path: {"bounds": [0, 1], "per": "field", "resolution": 2, "initial": 0.5}}}
    built = build(load_scene(scene))
    (block,) = make_params(built).blocks
    assert block.size < len(built.particles.points["a"].x) == len(block.initial)


def test_a_muscle_can_be_stronger_in_one_group(built, rng):
    """One weight per group of the body; particles without a group keep the weight of the actuator."""
    assembly, path = built.assembly, "actuators.muscle.muscle.weight"
    values = {path: np.array([0.25])}
    (slot,) = (k for k, part in enumerate(assembly.actuation.parts) if part.name == "muscle")
    particles = assembly.actuation.parts[slot].model.particles
    tip = np.isin(particles, built.particles.groups("a")["tip"])
    assert 0 < tip.sum() < len(tip)
    inputs = assembly.inputs(values)
    part = built.model.weight_slices[slot]
    np.testing.assert_array_equal(inputs.weights[part], np.where(tip, 0.25, 1.0))
    bar = random_bar(inputs, rng)
    assert assembly.gradient(values, bar)[path] == pytest.approx([bar.weights[part][tip].sum()], rel=1e-14)


@pytest.mark.parametrize(
    ("unknown", "advice"),
    [
        ("actuators.muscle.muscle.strength", ", or the unknown 'actuators.muscle.muscle.weight', the share of the "),
        ("bodies.a.velocity.0", "$"),
    ],
)
def test_the_error_names_the_values_that_can_differ_by_group(unknown, advice):
    message = f"only a body's material, and an actuator's `weight`, can differ by group; use `per: body`{advice}"
    with pytest.raises(SceneError, match=message):
        load_scene(everything(2), [f"unknowns={{{unknown}: {{bounds: [0, 100], per: group}}}}"])
