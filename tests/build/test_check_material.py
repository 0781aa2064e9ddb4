"""What is said of materials before a run: stability, relaxation times, float32."""

from __future__ import annotations

from typing import Any

import pytest
import yaml

from cqrun.build.model import build
from cqrun.errors import SceneError
from cqrun.jobs.validate import validate
from cqrun.scene.load import load_scene


def scene(elastic: dict[str, Any], prony: dict[str, float] | None = None, **more: Any) -> Any:
    """Return the scene of a bar that moves for 0.1 s in 200 substeps."""
    material = {"density": 1000, "elastic": elastic} | ({} if prony is None else {"prony": prony})
    data = {
        "cqrun": 1,
        "world": {"size": [0.2, 0.1], "dx": 0.01},
        "bodies": {
            "bar": {
                "shape": {"box": {"corner": [0.02, 0.02], "size": [0.12, 0.03]}},
                "particles_per_cell": 4,
                "material": material,
            }
        },
        "time": {"duration": 0.1, "control_step": 0.01, "substeps": 20},
    }
    return load_scene(data | more)


def warned(*given: Any, **more: Any) -> list[str]:
    return [str(w) for w in build(scene(*given, **more)).warnings]


YEOH = {"c10": 500.0, "poissons_ratio": 0.3}
"""A law that the substeps suit."""


def test_a_law_that_loses_stability_is_warned_about():
    (message,) = warned({"yeoh": YEOH | {"c20": -120.0}})
    assert (
        "bodies.bar.material.elastic.yeoh: has its largest force in equibiaxial tension at a stretch of 1." in message
    )
    assert warned({"yeoh": YEOH}) == []


def test_a_law_whose_stress_has_no_bound_is_not_said_to_give_way():
    (message,) = warned({"gent": {"mu": 1000.0, "jm": 0.5, "poissons_ratio": 0.3}})
    assert "gent: reaches its limit in equibiaxial tension at a stretch of 1." in message
    assert "no body can be stretched farther, because its stress grows without bound there" in message


def test_the_material_of_a_region_is_warned_about_like_that_of_the_body():
    left = {"elastic": {"yeoh": YEOH | {"c20": -120.0}}, "prony": {"ratio_1": 0.1, "time_1": 1e-4}}
    given = scene({"yeoh": YEOH}, {"ratio_1": 0.1, "time_1": 0.05}).model_dump(exclude_none=True, exclude_defaults=True)
    given["bodies"]["bar"] |= {
        "groups": {"left": {"box": {"corner": [0, 0], "size": [0.05, 0.1]}}},
        "material_of": {"left": left},
    }
    law, branch = [str(w) for w in build(load_scene(given)).warnings]
    assert "bodies.bar.material_of.left.elastic.yeoh: has its largest force in equibiaxial tension" in law
    assert "bodies.bar.material_of.left.prony.time_1: 0.0001 s is shorter than a substep of 0.0005 s" in branch


@pytest.mark.parametrize(
    ("time", "words"),
    [
        (1e-4, "prony.time_2: 0.0001 s is shorter than a substep of 0.0005 s"),
        (1.1, "prony.time_2: 1.1 s is more than 10 times as long as the run"),
    ],
)
def test_times_that_no_run_shows_are_warned_about(time, words):
    (message,) = warned({"yeoh": YEOH}, {"ratio_1": 0.1, "time_1": 0.05, "ratio_2": 0.1, "time_2": time})
    assert words in message


def test_float32_is_refused_where_a_stress_relaxes():
    prony = {"ratio_1": 0.1, "time_1": 0.05}
    assert warned({"yeoh": YEOH}, prony) == []
    with pytest.raises(SceneError, match="precision: is float32, but the stress of 'bar' relaxes in each substep by"):
        build(scene({"yeoh": YEOH}, prony, precision="float32"))
    build(scene({"yeoh": YEOH}, precision="float32"))


def test_a_law_that_does_not_tell_the_part_of_its_volume_cannot_relax(monkeypatch):
    monkeypatch.setattr("cqrun.build.volumes.has_volume", lambda kernel_class: False)
    with pytest.raises(SceneError, match="prony: relaxes what `yeoh` answers to a change of shape"):
        build(scene({"yeoh": YEOH}, {"ratio_1": 0.1, "time_1": 0.05}))


def test_validate_tells_the_moduli_of_a_region(tmp_path):
    path = tmp_path / "bar.yaml"
    given = scene({"yeoh": YEOH}).model_dump(exclude_none=True, exclude_defaults=True)
    given["bodies"]["bar"] |= {
        "groups": {"left": {"box": {"corner": [0, 0], "size": [0.05, 0.1]}}},
        "material_of": {"left": {"elastic": {"yeoh": YEOH | {"c10": 700.0}}}},
    }
    path.write_text(yaml.safe_dump(given))
    whole, left = (line for line in validate(path) if "yeoh" in line and "mu" in line)
    assert "yeoh: mu 1000 Pa" in whole
    assert "yeoh of left: mu 1400 Pa" in left


def test_validate_tells_the_moduli_and_the_stable_range(tmp_path):
    path = tmp_path / "bar.yaml"
    path.write_text(
        yaml.safe_dump(
            scene({"gent": {"mu": 900.0, "jm": 8, "bulk_modulus": 4e3}}).model_dump(
                exclude_none=True, exclude_defaults=True
            )
        )
    )
    (line,) = (line for line in validate(path) if "gent:" in line)
    assert "gent: mu 900 Pa, K 4000 Pa, E 2512 Pa, nu 0.39535 at rest; stable up to a stretch of 2" in line
    assert line.endswith("(equibiaxial)")
