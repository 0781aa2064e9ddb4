"""Cables and springs say how far the points of their routes are from the particles that they are tied to."""

from __future__ import annotations

from typing import Any

import pytest

from cqrun.build.check_routes import tied
from cqrun.build.model import Built, build
from cqrun.jobs.validate import validate
from cqrun.running.bodies import on_particles
from cqrun.scene.load import load_scene

SPACING = 0.01
BODY = {
    "shape": {"box": {"corner": [0.2, 0.2], "size": [0.4, 0.08]}},
    "spacing": SPACING,
    "material": {"density": 1000, "elastic": {"neo_hookean": {"youngs_modulus": 1e5, "poissons_ratio": 0.3}}},
}


def scene(height: float, kind: str = "cable", **changes: Any) -> dict[str, Any]:
    """Return a beam from y = 0.2 to 0.28 m with a cable or a spring at some height."""
    spec = {"body": "beam", "route": [[0.205, 0.205], [0.595, height]], "stiffness": 10.0}
    section = {"cable": "actuators", "spring": "forces"}[kind]
    return {
        "cqrun": 1,
        "world": {"size": [1, 0.5], "dx": 0.02, "frame": "updated"},
        "bodies": {"beam": BODY | changes},
        section: {"pull": {kind: spec}},
        "time": {"duration": 0.1, "control_step": 0.1},
    }


def built(height: float, kind: str = "cable", **changes: Any) -> Built:
    return build(load_scene(scene(height, kind, **changes)))


def warnings(height: float, kind: str = "cable") -> list[str]:
    return [f"{w.path}: {w.message}" for w in built(height, kind).warnings if "route" in w.path]


@pytest.mark.parametrize("kind", ["cable", "spring"])
def test_the_farthest_point_of_a_route_is_found(kind):
    """The particles are 5 mm inside the surface."""
    beam = built(0.28, kind)
    (part,) = beam.assembly.actuation.every
    far = tied(beam.particles, part)
    assert far is not None
    assert (far.number, far.distance, far.spacing) == (1, pytest.approx(0.005), pytest.approx(SPACING))
    assert on_particles(beam, part) == "2 particles of 'beam', at most 5 mm (0.5 spacings) from the points of its route"


def test_what_has_no_route_is_not_tied():
    muscle = {"muscle": {"body": "beam", "axis": [1, 0], "strength": 10.0}}
    beam = build(load_scene(scene(0.28) | {"actuators": {"pull": muscle}}))
    (part,) = beam.assembly.actuation.every
    assert tied(beam.particles, part) is None
    assert on_particles(beam, part) == "320 particles of 'beam'"


@pytest.mark.parametrize(("height", "warned"), [(0.24, False), (0.28, False), (0.284, False), (0.286, True)])
@pytest.mark.parametrize("kind", ["cable", "spring"])
def test_a_point_outside_the_body_is_a_warning(height, warned, kind):
    section = {"cable": "actuators", "spring": "forces"}[kind]
    found = warnings(height, kind)
    if not warned:
        assert found == []
        return
    (message,) = found
    assert message == (
        f"{section}.pull.{kind}.route.1: is 11 mm (1.1 spacings) from the nearest particle, at (0.595, 0.275) m, to "
        "which it is tied: the pull acts there, with that lever arm; move the point into the body, or use more "
        "particles per cell"
    )


def test_validate_shows_cables_and_springs_with_their_distance(tmp_path):
    import yaml

    for kind, section in (("cable", "actuator"), ("spring", "force")):
        (tmp_path / "scene.yaml").write_text(yaml.safe_dump(scene(0.28, kind)))
        wanted = f"pull ({kind}): 2 particles of 'beam', at most 5 mm (0.5 spacings) from the points of its route"
        assert f"  {section:10} {wanted}" in list(validate(tmp_path / "scene.yaml"))


def test_a_run_says_at_its_start_what_a_cable_is_tied_to():
    from cqrun.running.bodies import report_bodies
    from cqrun.running.reporter import Silent

    said: list[str] = []
    talk, run = Silent(), type("Run", (), {"log": lambda self, text: said.append(text)})()
    report_bodies(built(0.28), run, talk)
    assert "pull: tied to 2 particles of 'beam', at most 5 mm (0.5 spacings) from the points of its route" in said
