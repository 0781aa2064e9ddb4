"""The scenes of the grids of a resolution study: what follows the grid, what is refused, and what differs."""

from __future__ import annotations

import copy

import pytest

from cqrun.build.model import build
from cqrun.build.thickness import thinnest_parts
from cqrun.errors import SceneError, UsageError
from cqrun.jobs.studies.grids import changes, differences, grid_overrides, grids_of, require_cells
from cqrun.scene.load import load_scene

SCENE = {
    "cqrun": 1,
    "world": {"size": [0.2, 0.2], "dx": 0.01, "gravity": [0, -9.81]},
    "bodies": {
        "beam": {
            "shape": {"box": {"corner": [0.02, 0.1], "size": [0.12, 0.02]}},
            "particles_per_cell": 4,
            "material": {
                "density": 1000,
                "elastic": {"fixed_corotated": {"youngs_modulus": 1e5, "poissons_ratio": 0.3}},
            },
        }
    },
    "boundaries": {"clamp": {"sticky": {"region": {"box": {"corner": [0, 0], "size": [0.04, 0.2]}}}}},
    "time": {"duration": 0.1, "control_step": 0.01},
}


def scene_of(**beam):
    data = copy.deepcopy(SCENE)
    data["bodies"]["beam"] |= beam
    return data


def on_grids(data, *cells):
    """Return a scene built on several grids."""
    scene = load_scene(data)
    return [build(load_scene(data, grid_overrides(scene, dx))) for dx in cells]


# --- the option -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "cells"),
    [
        ("auto", (0.01, 0.01 / 1.5)),
        ("0.01,0.005", (0.01, 0.005)),
        ("0.02, 0.01, 5e-3", (0.02, 0.01, 0.005)),
        ("0.01,0.00667", (0.01, 0.01 * 2 / 3)),  # so that nodes of both grids meet
        ("0.01,0.0066", (0.01, 0.0066)),
    ],
)
def test_two_or_three_grids(text, cells):
    assert grids_of(text, load_scene(SCENE)) == cells


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fine", "give two or three cell sizes in m, such as --resolution 0.01,0.0066667"),
        ("", "give two or three cell sizes in m"),
        ("0.01", "names 1; two or three grids are compared"),
        ("0.04,0.03,0.02,0.01", "names 4; two or three grids are compared"),
        ("0.01,0.01", "0.01 and 0.01 m are the same grid: give the finest grid last"),
        ("0.005,0.01", "0.005 and 0.01 m become coarser: give the finest grid last"),
        ("0.01,0.0099", "0.01 and 0.0099 m are too close"),
        ("0.01,0", "cell sizes are positive numbers"),
        ("0.01,-0.005", "cell sizes are positive numbers"),
        ("0.01,nan", "cell sizes are positive numbers"),
    ],
)
def test_other_grids_are_refused(text, message):
    with pytest.raises(UsageError, match="--resolution") as raised:
        grids_of(text, load_scene(SCENE))
    assert message in str(raised.value)


def test_a_grid_coarser_than_a_body_is_refused():
    (built,) = on_grids(SCENE, 0.02)
    require_cells(0.02, thinnest_parts(built))
    (coarse,) = on_grids(SCENE, 0.025)
    with pytest.raises(UsageError, match=r"cells of 0.025 m are coarser than the body 'beam'.*at most 0.02 m"):
        require_cells(0.025, thinnest_parts(coarse))


# --- particles and substeps -------------------------------------------------------------------------------------------


def test_particles_per_cell_follow_the_grid_by_themselves():
    scene = load_scene(SCENE)
    assert grid_overrides(scene, 0.01) == []
    assert grid_overrides(scene, 0.005) == ["world.dx=0.005"]
    coarse, fine = on_grids(SCENE, 0.01, 0.005)
    assert len(fine.particles.x) == 4 * len(coarse.particles.x)


def test_a_spacing_and_a_number_of_substeps_are_scaled():
    data = scene_of(particles_per_cell=None, spacing=0.005) | {"time": SCENE["time"] | {"substeps": 30}}
    scene = load_scene(data)
    overrides = grid_overrides(scene, 0.01 / 1.5)
    assert overrides[2] == "time.substeps=45"
    assert overrides[1].startswith("bodies.beam.spacing=0.0033333333333")
    told = list(changes(scene, 0.01 / 1.5, overrides))
    assert told[0].endswith("with cells of 0.0066667 m: particles follow the grid")
    assert told[1].startswith("time.substeps is 30 in the scene, and 45 with cells of 0.0066667 m")
    coarse, fine = on_grids(data, 0.01, 0.01 / 1.5)
    assert len(fine.particles.x) == pytest.approx(1.5**2 * len(coarse.particles.x))
    assert (coarse.model.substeps, fine.model.substeps) == (30, 45)
    assert grid_overrides(scene, 0.02)[2] == "time.substeps=15"


def test_a_count_is_scaled_if_it_stays_whole():
    counted = {"particles_per_cell": None, "sampling": {"lattice": {"count": 20}}}
    scene = load_scene(scene_of(**counted))
    assert "bodies.beam.sampling.lattice.count=30" in grid_overrides(scene, 0.01 / 1.5)
    with pytest.raises(UsageError, match=r"count is 20, which would have to become 28.57 .* `particles_per_cell`"):
        grid_overrides(scene, 0.007)
    random = load_scene(scene_of(particles_per_cell=None, sampling={"random": {"count": 100}}))
    assert "bodies.beam.sampling.random.count=225" in grid_overrides(random, 0.01 / 1.5)


def test_masses_of_particles_that_grow_with_their_number_are_refused():
    with pytest.raises(UsageError, match="every particle of 'beam' has the same mass on every grid"):
        grid_overrides(load_scene(scene_of(unit_mass=True)), 0.005)


# --- what else differs ------------------------------------------------------------------------------------------------


def test_grids_that_fit_the_scene_differ_in_nothing():
    assert list(differences(on_grids(SCENE, 0.01, 0.01 / 1.5, 0.005))) == []


def test_a_region_that_holds_particles_on_one_grid_alone():
    data = scene_of(groups={"slice": {"box": {"corner": [0.1383, 0.1], "size": [0.0013, 0.02]}}})
    on_grids(data, 0.005)
    with pytest.raises(SceneError, match=r"bodies\.beam\.groups\.slice: holds no particle"):
        on_grids(data, 0.01, 0.005)


def test_an_attached_mass_on_other_particles():
    region = {"box": {"corner": [0.132, 0.1], "size": [0.008, 0.02]}}
    data = SCENE | {"loads": {"weight": {"attached_mass": {"body": "beam", "mass": 0.1, "region": region}}}}
    (told,) = differences(on_grids(data, 0.01, 0.01 / 1.5))
    assert told.startswith("loads.weight.attached_mass.region holds 8 particles with cells of 0.01 m, and 12 with")
    assert "33 % less volume" in told


def test_a_body_whose_mass_differs():
    data = scene_of(shape={"box": {"corner": [0.02, 0.1], "size": [0.12, 0.025]}})
    told = list(differences(on_grids(data, 0.01, 0.01 / 1.5)))
    assert len(told) == 1
    assert told[0].startswith("the mass of 'beam' is 3 kg/m, 3.2 kg/m on the grids")


UPDATED = SCENE | {"world": SCENE["world"] | {"frame": "updated"}}


def test_a_clamp_whose_end_moves():
    clamp = {"clamp": {"sticky": {"region": {"box": {"corner": [0, 0], "size": [0.047, 0.2]}}}}}
    (told,) = differences(on_grids(UPDATED | {"boundaries": clamp}, 0.01, 0.01 / 1.5))
    assert told.startswith("boundaries.clamp holds nodes up to 0.0066667 m farther on one grid than on the other")
    assert "put its faces on nodes of both grids" in told


def test_in_the_reference_frame_a_clamp_ends_at_its_face_on_every_grid():
    clamp = {"clamp": {"sticky": {"region": {"box": {"corner": [0, 0], "size": [0.047, 0.2]}}}}}
    data = SCENE | {"boundaries": clamp, "world": SCENE["world"] | {"frame": "reference"}}
    assert list(differences(on_grids(data, 0.01, 0.01 / 1.5))) == []
    clamp["second"] = {"sticky": {"region": {"box": {"corner": [0.113, 0], "size": [0.1, 0.2]}}}}  # 6.6 and 9.9 cells
    told = list(differences(on_grids(data, 0.01, 0.01 / 1.5)))
    assert any(text.startswith("boundaries.second holds nodes up to ") for text in told)


def test_a_clamp_that_holds_a_body_on_one_grid_alone():
    clamp = {"clamp": {"sticky": {"region": {"box": {"corner": [0, 0], "size": [0.0225, 0.2]}}}}}
    told = list(differences(on_grids(UPDATED | {"boundaries": clamp}, 0.0125, 0.005)))
    assert any(text.startswith("boundaries.clamp holds") and "none with cells of 0.0125 m" in text for text in told)
