"""The grid of each body has a row of nodes on the face of its clamp: what is free does not depend on the grid."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from little_worlds import needs_jit

from cqrun.build.alignment import held_faces
from cqrun.build.model import Built, build
from cqrun.engine.reference.rest import rest_geometry
from cqrun.engine.statics.equilibrium import Equilibrium
from cqrun.scene.load import load_scene

DX = 0.02
MATERIAL = {"density": 1000, "elastic": {"fixed_corotated": {"youngs_modulus": 2e4, "poissons_ratio": 0.3}}}


def beam(corner: Any = (0.2, 0.4), size: Any = (0.4, 0.1)) -> dict[str, Any]:
    """Return a body."""
    return {"shape": {"box": {"corner": list(corner), "size": list(size)}}, "particles_per_cell": 4,
            "material": MATERIAL}  # fmt: skip


def box(lower: Any, upper: Any) -> dict[str, Any]:
    """Return a region."""
    return {"box": {"corner": list(lower), "size": [b - a for a, b in zip(lower, upper, strict=True)]}}


FIT = {
    "job": "sysid",
    "unknowns": {"bodies.beam.material.elastic.fixed_corotated.youngs_modulus": {"bounds": [1e4, 1e5]}},
    "data": {"synthetic": {
        "truth": {"bodies.beam.material.elastic.fixed_corotated.youngs_modulus": 3e4}, "noise": 1e-4, "every": 1,
        "body": "beam", "markers": {"end": [0.59, 0.45]},
    }},
}  # fmt: skip


def built(
    boundaries: dict[str, Any], dx: float = DX, frame: str = "reference", fit: bool = False, **bodies: Any
) -> Built:
    """Return a model of a beam, or of other bodies, in a world of 1 m."""
    return build(load_scene((FIT if fit else {}) | {
        "cqrun": 1, "world": {"size": [1, 1], "dx": dx, "frame": frame, "gravity": [0, -1]},
        "bodies": bodies or {"beam": beam()}, "boundaries": boundaries, "time": {"duration": 0.1, "control_step": 0.1},
    }))  # fmt: skip


def offset_in_cells(found: Built) -> list[list[float]]:
    """Return the offsets of all grids."""
    assert found.model.offset is not None
    return (found.model.offset / found.model.dx).round(9).tolist()


REGIONS: dict[str, tuple[Any, list[float]]] = {
    "reaches over the body": (box([0.1, 0.3], [0.247, 0.6]), [0.35, 0.0]),
    "as wide as the body": (box([0.2, 0.4], [0.247, 0.5]), [0.35, 0.0]),
    "beside the body": (box([0.1, 0.3], [0.2, 0.6]), [0.0, 0.0]),
    "from above": (box([0.1, 0.473], [0.9, 0.6]), [0.0, -0.35]),
    "over a corner": (box([0.1, 0.3], [0.247, 0.433]), [0.35, -0.35]),
    "half-space": ({"half_space": {"point": [0.253, 0], "normal": [1, 0]}}, [-0.35, 0.0]),
    "oblique half-space": ({"half_space": {"point": [0.253, 0.4], "normal": [0.8, 0.6]}}, [0.0, 0.0]),
    "union": ({"union": [box([0.1, 0.3], [0.247, 0.6]), box([0.55, 0.433], [0.7, 0.6])]}, [0.35, -0.35]),
    "a ball": ({"ball": {"center": [0.2, 0.45], "radius": 0.07}}, [0.0, 0.0]),
}  # fmt: skip


@pytest.mark.parametrize("name", REGIONS)
def test_a_row_of_nodes_lies_on_the_face_of_a_clamp(name):
    region, offset = REGIONS[name]
    found = offset_in_cells(built({"clamp": {"sticky": {"region": region}}}))
    np.testing.assert_allclose(found, [offset], atol=1e-9)


def test_the_face_is_a_row_that_is_held_and_the_next_row_is_free():
    found = built({"clamp": {"sticky": {"region": box([0.1, 0.3], [0.247, 0.6])}}})
    rest = rest_geometry(found.model, found.particles.x)
    x, bits = rest.patches.positions(found.model.dx), rest.held(found.model).bits
    rows = np.unique(x[bits != 0, 0])
    np.testing.assert_allclose(rows.max(), 0.247, atol=1e-12)
    np.testing.assert_allclose(np.unique(x[bits == 0, 0]).min(), 0.247 + DX, atol=1e-12)


def test_faces_of_the_world_and_slip_are_aligned_too():
    floor = {"floor": {"slip": {"face": "y_min", "thickness": 0.407}}}
    assert offset_in_cells(built(floor)) == [[0.0, 0.35]]


def test_a_region_by_its_name_counts_as_itself():
    found = build(load_scene({
        "cqrun": 1, "world": {"size": [1, 1], "dx": DX}, "bodies": {"beam": beam()},
        "regions": {"wall": box([0.1, 0.3], [0.247, 0.6])},
        "boundaries": {"clamp": {"sticky": {"region": "wall"}}}, "time": {"duration": 0.1, "control_step": 0.1},
    }))  # fmt: skip
    assert offset_in_cells(found) == [[0.35, 0.0]]


def test_every_body_has_its_own_grid():
    clamps = {
        "left": {"sticky": {"region": box([0.1, 0.3], [0.247, 0.6])}},
        "right": {"sticky": {"region": box([0.1, 0.6], [0.254, 0.9])}},
    }
    found = built(clamps, a=beam(), b=beam([0.2, 0.7]))
    assert offset_in_cells(found) == [[0.35, 0.0], [-0.3, 0.0]]
    assert not [w for w in found.warnings if "between two rows" in str(w)]


def test_a_grid_that_fits_is_not_moved():
    found = built({"clamp": {"sticky": {"region": box([0.1, 0.3], [0.24, 0.6])}}})
    assert not found.model.offset.any()


def test_a_second_face_that_does_not_fit_is_told_with_a_spacing_that_does():
    clamps = {
        "left": {"sticky": {"region": box([0.1, 0.3], [0.247, 0.6])}},
        "right": {"sticky": {"region": box([0.556, 0.3], [0.7, 0.6])}},
    }
    (warning,) = [w for w in built(clamps).warnings if "between two rows" in w.message]
    assert warning.path == "boundaries.right.sticky"
    assert "ends at x = 0.556 m between two rows of nodes, so it holds 'beam' only to x = 0.567 m" in warning.message
    assert "0.011 m more of it are free: set a dx that divides 0.309 m, such as 0.0193125" in warning.message
    assert not [w for w in built(clamps, dx=0.0193125).warnings if "between two rows" in w.message]


def test_the_other_frame_cannot_move_its_grid_and_says_so_before_a_fit():
    clamp = {"clamp": {"sticky": {"region": box([0.1, 0.3], [0.247, 0.6])}}}
    assert not [w for w in built(clamp, frame="updated").warnings if "between two rows" in w.message]
    found = built(clamp, frame="updated", fit=True)
    assert found.model.offset is None
    (warning,) = [w for w in found.warnings if "between two rows" in w.message]
    assert "holds 'beam' only to x = 0.24 m, and 0.007 m more of it are free" in warning.message


def test_a_face_counts_only_where_it_ends_within_the_body():
    regions = {"clamp": {"sticky": {"region": box([0.13, 0.33], [0.247, 0.61])}}}
    found = built(regions)
    assert [(face.axis, face.at, face.side) for face in held_faces(found.scene, found.particles, "beam")] == [
        (0, 0.247, 1)
    ]


@needs_jit
def test_a_beam_sags_alike_wherever_it_stands_on_the_world_s_grid():
    """The scene moved along the beam by any part of a cell is the same scene."""
    sags = []
    for shift in (0.0, 0.003, 0.0117):
        clamp = {"clamp": {"sticky": {"region": box([0.1 + shift, 0.3], [0.24 + shift, 0.6])}}}
        found = built(clamp, beam=beam([0.2 + shift, 0.4]))
        equilibrium = Equilibrium(found.model, found.assembly.inputs({}))
        order = np.lexsort((found.particles.x - [shift, 0]).round(9).T)
        sags.append(equilibrium.state(equilibrium.solve(tolerance=1e-11).u).x[order, 1])
    assert sags[0].min() < 0.39
    for sag in sags[1:]:
        np.testing.assert_allclose(sag, sags[0], atol=1e-9)
