"""Where cables act: exact points of routes, guides, points of the world, several routes on a spool; and bad routes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cqrun.build.matter import matter_of
from cqrun.build.model import Built, build
from cqrun.errors import SceneError
from cqrun.forces.helix import Helix
from cqrun.jobs.validate import validate
from cqrun.running.bodies import on_particles
from cqrun.scene.load import load_scene

BOX = {"box": {"corner": [0.2, 0.2], "size": [0.4, 0.08]}}
RING = {"difference": {"shapes": [BOX, {"box": {"corner": [0.36, 0.22], "size": [0.08, 0.04]}}]}}


def scene(cable: dict[str, Any], *, shape: dict[str, Any] = BOX, frame: str = "reference") -> dict[str, Any]:
    """Return a beam from x = 0.2 to 0.6 m and y = 0.2 to 0.28 m with a cable."""
    law = {} if "stiffness" in cable else {"tension": 1.0}
    return {
        "cqrun": 1,
        "world": {"size": [1, 0.5], "dx": 0.02, "frame": frame},
        "bodies": {"beam": {
            "shape": shape, "spacing": 0.01,
            "material": {"density": 1000, "elastic": {"neo_hookean": {"youngs_modulus": 1e5, "poissons_ratio": 0.3}}},
        }},
        "actuators": {"pull": {"cable": {"body": "beam"} | law | cable}},
        "time": {"duration": 0.1, "control_step": 0.1},
    }  # fmt: skip


def built(cable: dict[str, Any], **more: Any) -> Built:
    return build(load_scene(scene(cable, **more)))


def refused(cable: dict[str, Any], **more: Any) -> str:
    with pytest.raises(SceneError) as error:
        built(cable, **more)
    return str(error.value)


def part_of(beam: Built) -> Any:
    (part,) = beam.assembly.actuation.every
    return part


# --- exact points -----------------------------------------------------------------------------------------------------

ROUTE = [[0.2, 0.231], [0.6, 0.231]]


def test_in_the_reference_frame_a_cable_acts_at_the_exact_points_of_its_route():
    beam = built({"route": ROUTE, "spacing": 0.05})
    points = part_of(beam).model.at_rest(beam.particles.x)
    np.testing.assert_allclose(points, np.stack([np.linspace(0.2, 0.6, 9), np.full(9, 0.231)], axis=1), atol=1e-15)
    assert beam.assembly.inputs({}).rest == pytest.approx([0.4], abs=1e-15)
    assert on_particles(beam, part_of(beam)) == "9 points of 'beam'"


def test_in_the_updated_frame_it_is_tied_to_particles_and_says_how_far_they_are(tmp_path):
    import yaml

    beam = built({"route": ROUTE, "spacing": 0.05}, frame="updated")
    points = part_of(beam).model.at_rest(beam.particles.x)
    np.testing.assert_allclose(points[:, 1], 0.235, atol=1e-12)
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(scene({"route": ROUTE}, frame="updated")))
    wanted = "pull (cable): 2 particles of 'beam', at most 6.4 mm (0.64 spacings) from the points of its route"
    assert any(wanted in line for line in validate(tmp_path / "scene.yaml"))


def test_the_rest_length_of_a_stretched_design_is_that_of_its_points():
    """The points keep their distance to the particles that they ride on; its adjoint agrees with differences."""
    beam = built({"route": [[0.201, 0.23], [0.4, 0.25], [0.599, 0.22]], "stiffness": 1.0})
    drive, x = beam.assembly.actuation, beam.particles.x
    change = np.random.default_rng(0).normal(size=x.shape)
    by_hand = (drive.rest_lengths(x + 1e-6 * change) - drive.rest_lengths(x - 1e-6 * change)) / 2e-6
    assert (drive.rest_lengths_vjp(x, np.ones(1)) * change).sum() == pytest.approx(by_hand[0], rel=1e-8)


def test_its_length_is_measured_along_the_exact_points():
    given = scene({"route": ROUTE})
    given["measure"] = {"rope": {"cable_length": {"cable": "pull"}}}
    beam = build(load_scene(given))
    matter = matter_of(beam, {})
    measure = matter.measured("rope")
    route = matter.routes["pull"]
    x, F = beam.particles.x[route.particles], np.tile(np.eye(2), (2, 1, 1))
    turned = np.array([[0.0, -1.0], [1.0, 0.0]])
    track = type("T", (), {"x": np.stack([x, x @ turned.T]), "F": np.stack([F, turned @ F])})()
    assert measure.values(track)[:, 0] == pytest.approx([0.4, 0.4], abs=1e-14)


# --- guides and the world ---------------------------------------------------------------------------------------------


def test_a_pulley_and_an_anchor_are_points_of_the_world():
    beam = built({"route": ROUTE, "pulley": [0.2, 0.131], "anchor": [0.6, 0.431]})
    model = part_of(beam).model
    assert list(model.particles < 0) == [True, False, False, True]
    np.testing.assert_allclose(model.at_rest(beam.particles.x)[[0, 3]], [[0.2, 0.131], [0.6, 0.431]])
    assert beam.assembly.inputs({}).rest == pytest.approx([0.1 + 0.4 + 0.2])
    assert on_particles(beam, part_of(beam)) == "2 points of 'beam' and 2 in the world"
    x_bar = beam.assembly.actuation.rest_lengths_vjp(beam.particles.x, np.ones(1))
    assert np.flatnonzero(x_bar.any(axis=1)).tolist() == sorted(model.particles[1:3].tolist())


def test_points_of_the_world_need_the_reference_frame():
    message = refused({"route": ROUTE, "anchor": [0.7, 0.231]}, frame="updated")
    assert "actuators.pull.cable" in message
    assert "acts in the reference frame alone" in message


@pytest.mark.parametrize("turns", [1.5, -0.5])
def test_a_helix_winds_around_its_axis(turns):
    """By the right hand for a positive number of turns, as a thread of a screw."""
    helix = Helix(axis=[[0, 0, 0], [0, 0, 2]], begin=[0.3, 0, 0.5], turns=turns, end_radius=0.1)
    points = helix.points(None)
    part = (points[:, 2] - 0.5) / 1.5
    assert len(points) == 1 + round(24 * abs(turns))
    np.testing.assert_allclose(np.hypot(points[:, 0], points[:, 1]), 0.3 - 0.2 * part, atol=1e-15)
    angle = np.unwrap(np.arctan2(points[:, 1], points[:, 0]))
    np.testing.assert_allclose(angle, 2 * np.pi * turns * part, atol=1e-12)
    same = Helix(axis=[[0, 0, 0], [0, 0, 2]], begin=[0.3, 0, 0.5], pitch=1.5 / turns, end_radius=0.1)
    np.testing.assert_allclose(same.points(None), points, atol=1e-12)
    assert np.linalg.norm(np.diff(helix.points(0.05), axis=0), axis=1).max() < 0.055


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"turns": None}, "exactly one of `turns` and `pitch`"),
        ({"pitch": 1.0}, "exactly one of `turns` and `pitch`"),
        ({"turns": None, "pitch": 0.0}, "has a pitch of 0"),
        ({"begin": [0.0, 0.0, 0.5]}, "must not lie on the axis"),
        ({"axis": [[0, 0, 1], [0, 0, 1]]}, "must have two different points"),
    ],
)
def test_a_helix_that_makes_no_sense_is_refused(changes, message):
    fields = {"axis": [[0, 0, 0], [0, 0, 2]], "begin": [0.3, 0, 0.5], "turns": 1.0} | changes
    cable = {"body": "beam", "tension": 1.0, "helix": fields}
    box = {"box": {"corner": [0, 0, 0], "size": [1, 1, 1]}}
    given = scene({}, shape=box) | {"actuators": {"pull": {"cable": cable}}}
    given["world"]["size"] = [1.0, 1.0, 1.0]
    with pytest.raises(SceneError) as error:
        load_scene(given)
    assert message in str(error.value)


def test_a_helix_needs_three_dimensions():
    helix = {"axis": [[0.2, 0.24], [0.6, 0.24]], "begin": [0.2, 0.25, 0.0], "turns": 1}
    assert "a helix needs a 3D world" in refused({"helix": helix})


# --- spools -----------------------------------------------------------------------------------------------------------

PAIR = [[[0.2, 0.21], [0.6, 0.21]], [[0.2, 0.27], [0.4, 0.27]]]


@pytest.mark.parametrize(
    ("law", "limits", "levels"),
    [
        ({"tension": 2.0}, (-1.0, 1.0), {0.5: (0.5, -0.5), -0.5: (-0.5, 0.5)}),
        # what is wound up of the first, 0.1 of 0.4 m, is let out of the second: 0.2 + 0.04 m
        ({"stiffness": 9.0}, (0.0, 2.0), {0.9: (0.9, 0.6), 1.0: (1.0, 0.5), 1.1: (1.1, 0.4)}),
    ],
)
def test_a_spool_winds_up_one_cable_and_lets_out_the_other(law, limits, levels):
    beam = built({"routes": PAIR, "signs": [1, -1]} | law)
    part = part_of(beam)
    assert part.spec.limits == limits
    assert beam.assembly.inputs({}).rest == pytest.approx([0.4])
    routes = matter_of(beam, {}).routes
    assert list(routes) == ["pull", "pull.1"]
    for u, wanted in levels.items():
        assert [r.begin + r.turn * u for r in routes.values()] == pytest.approx(wanted)


def test_routes_on_a_spool_that_do_not_fit_are_refused():
    assert "needs one sign for each of `routes`; has 1 for 2" in refused({"routes": PAIR, "signs": [1]})
    assert "exactly one of `route`, `routes` and `helix`; has `route` and `routes`" in refused(
        {"routes": PAIR, "route": ROUTE}
    )
    assert "exactly one of `route`, `routes` and `helix`; has none" in refused({})


@pytest.mark.parametrize(("law", "fits"), [({"tension": 2.0}, True), ({"stiffness": 9.0}, False)])
def test_a_spool_that_sets_lengths_does_not_follow_an_unknown_shape(law, fits):
    given = scene({"routes": PAIR} | law) | {
        "job": "codesign", "unknowns": {"bodies.beam.shape.box.size.1": {"bounds": [0.076, 0.08]}},
        "objective": {"small": {"volume": {"body": "beam"}}},
    }  # fmt: skip
    if fits:
        build(load_scene(given))
        return
    with pytest.raises(SceneError) as error:
        build(load_scene(given))
    assert "actuators.pull.cable sets the lengths of several cables in 'beam'" in str(error.value)


# --- bad routes -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("y", "fits"), [(0.28, True), (0.2809, True), (0.282, False)])
def test_a_point_on_the_surface_fits_and_one_outside_is_refused(y, fits):
    cable = {"route": [[0.3, 0.24], [0.5, y]]}
    if fits:
        built(cable)
    else:
        wanted = f"actuators.pull.cable: its point (0.5, {y}) lies outside the body 'beam' or in a cavity"
        assert wanted in refused(cable)


def test_a_point_in_a_chamber_is_refused():
    assert "(0.4, 0.24) lies outside the body 'beam' or in a cavity of it" in refused(
        {"route": [[0.25, 0.24], [0.4, 0.24]]}, shape=RING
    )


def test_a_line_through_a_chamber_is_warned_about_unless_it_is_meant():
    cable = {"route": [[0.25, 0.24], [0.55, 0.24]], "spacing": 0.02}
    (found,) = (w for w in built(cable, shape=RING).warnings if w.path == "actuators.pull.cable")
    assert "leaves the body 'beam', at (0.4048, 0.24) m for one" in found.message
    meant = built(cable | {"free": True}, shape=RING)
    assert not [w for w in meant.warnings if w.path == "actuators.pull.cable"]
    x = part_of(meant).model.at_rest(meant.particles.x)[:, 0]
    assert np.diff(x).max() > 0.08  # nothing holds it in the chamber
    assert np.median(np.diff(x)) == pytest.approx(0.02)


@pytest.mark.parametrize("field", ["tension", "friction"])
def test_a_negative_tension_and_friction_are_refused(field):
    assert f"actuators.pull.cable.{field}: must be at least 0" in refused({"route": ROUTE, field: -1.0})
