"""Materials that differ by region inside a body: values, gradients, bounds on the substep, and errors."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest

from cqrun.build.assembly import Assembly
from cqrun.build.model import build
from cqrun.build.particles import sample
from cqrun.errors import SceneError
from cqrun.scene.load import dump, load_scene, resolve
from cqrun.scene.schema import Scene

BASE = "bodies.b.material"
E, SHEAR, DENSITY = "elastic.neo_hookean.youngs_modulus", "viscosity.shear", "density"
PARTS = {
    "leg": {"box": {"corner": [0.1, 0.1], "size": [0.2, 0.2]}},
    "arm": {"box": {"corner": [0.1, 0.3], "size": [0.4, 0.2]}},
}
LOW = {"half_space": {"point": [0, 0.2], "normal": [0, 1]}}
LAW = {"neo_hookean": {"youngs_modulus": 10.0, "poissons_ratio": 0.3}}
STIFF = {"neo_hookean": {"youngs_modulus": 40.0, "poissons_ratio": 0.2}}


def scene(others: dict[str, Any], *overrides: str, **more: Any) -> Scene:
    """Return a scene with a body of 48 particles: a leg of 16, its lower half in the region `low`, and an arm."""
    material = {"density": 2.0, "elastic": LAW, "viscosity": {"shear": 1.0}, "incompressibility": {"power": 2}}
    data = {
        "cqrun": 1,
        "world": {"size": [1.0, 1.0], "dx": 0.1, "frame": "updated"},
        "regions": {"low": LOW},
        "bodies": {"b": {"parts": PARTS, "spacing": 0.05, "material": material, "material_of": others}},
        "time": {"duration": 0.1, "control_step": 0.1},
        **more,
    }
    return load_scene(data, overrides)


OTHERS = {"leg": {"elastic": STIFF, "density": 4.0}, "low": {"density": 8.0, "viscosity": {"shear": 0.5}}}


def regions(loaded: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return which particles are in the leg, and which are in its lower half."""
    particles = sample(loaded)
    leg, low = (np.isin(np.arange(48), particles.inside("b", name)) for name in ("leg", "low"))
    return leg, low


def test_regions_have_separate_values_and_the_later_entry_wins() -> None:
    loaded = scene(OTHERS)
    leg, low = regions(loaded)
    inputs = Assembly(loaded, sample(loaded)).inputs({})
    neo_hookean, incompressible, viscosity = inputs.terms[0]
    assert (leg.sum(), low.sum()) == (16, 8)
    assert np.array_equal(neo_hookean[0], np.where(leg, 40.0, 10.0))
    assert np.array_equal(neo_hookean[1], np.where(leg, 0.2, 0.3))
    # a term that reads the elastic law's values reads those of the region
    assert np.array_equal(incompressible[0], np.where(leg, 40.0, 10.0))
    assert np.array_equal(viscosity[0], np.where(low, 0.5, 1.0))
    assert inputs.fields.mass == pytest.approx(np.where(low, 8.0, np.where(leg, 4.0, 2.0)) * 0.05**2)
    assert resolve(load_scene(dump(resolve(loaded)))) == resolve(loaded)


def test_the_stiffest_region_bounds_the_substep() -> None:
    stiff = {"neo_hookean": {"youngs_modulus": 1e3, "poissons_ratio": 0.3}}
    soft, in_part, as_a_whole = (
        build(built) for built in (scene({}), scene({"low": {"elastic": stiff}}), scene({}, f"{BASE}.{E}=1000"))
    )
    assert in_part.limits == as_a_whole.limits
    assert in_part.model.substeps == as_a_whole.model.substeps > 2 * soft.model.substeps


def test_values_by_path_reach_the_particles_of_a_region() -> None:
    loaded = scene(OTHERS)
    leg, low = regions(loaded)
    values = {f"{BASE}.{E}": np.array(20.0), f"{BASE}_of.leg.{E}": np.array(50.0)}
    values[f"{BASE}_of.low.density"] = np.array(9.0)
    inputs = Assembly(loaded, sample(loaded)).inputs(values)
    assert np.array_equal(inputs.terms[0][0][0], np.where(leg, 50.0, 20.0))
    assert inputs.fields.mass == pytest.approx(np.where(low, 9.0, np.where(leg, 4.0, 2.0)) * 0.05**2)


@pytest.mark.parametrize("per", ["body", "group", "particle"])
def test_the_gradient_agrees_with_differences(per: str, rng: np.random.Generator) -> None:
    loaded = scene(OTHERS)
    assembly = Assembly(loaded, sample(loaded))
    shape = {"body": (), "group": (2,), "particle": (48,)}[per]
    values = {f"{BASE}.{name}": 2.0 + rng.random(shape) for name in (E, SHEAR, DENSITY)}
    values |= {f"{BASE}_of.leg.{E}": np.array(30.0), f"{BASE}_of.low.{SHEAR}": np.array(2.0)}
    values |= {f"{BASE}_of.leg.density": np.array(3.0), f"{BASE}_of.low.density": np.array(5.0)}
    bar = copy.deepcopy(assembly.inputs(values))
    bar.state.v[:] = 0.0
    bar.fields.mass[:] = rng.normal(size=48)
    for term in bar.terms[0]:
        term[:] = rng.normal(size=term.shape)

    def loss(at: dict[str, np.ndarray]) -> float:
        inputs = assembly.inputs(at)
        pairs = [(inputs.fields.mass, bar.fields.mass), *zip(inputs.terms[0], bar.terms[0], strict=True)]
        return float(sum((a * b).sum() for a, b in pairs))

    gradient = assembly.gradient(values, bar)
    assert gradient.keys() == values.keys()
    for path, value in values.items():
        direction = rng.normal(size=value.shape)
        ends = [loss({**values, path: value + sign * direction}) for sign in (1, -1)]  # linear: any step will do
        assert (gradient[path] * direction).sum() == pytest.approx((ends[0] - ends[1]) / 2, rel=1e-11)
        assert np.any(gradient[path])


@pytest.mark.parametrize(
    ("others", "message"),
    [
        ({"leg": {"elastic": {"fixed_corotated": LAW["neo_hookean"]}}},
         "scene: bodies.b.material_of.leg.elastic: is another law than the body's neo_hookean: make this region a"),
        ({"leg": {"incompressibility": {"power": 4}}},
         "scene: bodies.b.material_of.leg.incompressibility.power: must be 2 as in the whole body, is 4; for another"),
        ({"lag": {"density": 3.0}}, "bodies.b.material_of.lag: there is no region 'lag' (did you mean 'leg'?)"),
        ({"leg": {"densty": 3.0}}, "material_of.leg.densty: unknown key (did you mean 'density'?)"),
        ({"leg": {"density": -3.0}}, "material_of.leg.density: must be greater than 0"),
    ],
)  # fmt: skip
def test_invalid_materials_are_refused(others: dict[str, Any], message: str) -> None:
    with pytest.raises(SceneError) as info:
        scene(others)
    assert message in str(info.value)


def test_a_term_that_the_body_lacks_is_refused() -> None:
    data = scene({}).model_dump(exclude_none=True)
    del data["bodies"]["b"]["material"]["viscosity"]
    data["bodies"]["b"]["material_of"] = {"leg": {"viscosity": {"shear": 1.0}}}
    with pytest.raises(SceneError, match=r"bodies.b.material_of.leg.viscosity: is not a term of the body's material"):
        load_scene(data)


def test_a_region_without_particles_is_refused() -> None:
    away = {"ball": {"center": [0.9, 0.9], "radius": 0.05}}
    with pytest.raises(SceneError, match=r"bodies.b.material_of.away: holds no particle"):
        sample(scene({"away": {"density": 3.0}}, regions={"away": away}))


def test_an_unknown_per_group_cannot_have_a_separate_region() -> None:
    unknowns = {f"{BASE}.{E}": {"bounds": [1, 100], "per": "group"}}
    with pytest.raises(SceneError, match=r"youngs_modulus.per: material_of sets a separate value for leg"):
        scene(OTHERS, unknowns=unknowns)
    others = {f"{BASE}.{E}": {"bounds": [1, 100]}, f"{BASE}_of.leg.{E}": {"bounds": [1, 100], "scale": "log"}}
    assert scene(OTHERS, unknowns=others).unknowns.keys() == others.keys()
