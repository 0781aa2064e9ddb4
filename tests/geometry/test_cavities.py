"""Meshes with cavities: in one file or in several, and the messages about those of which no body can be made."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from cqrun.build.particles import sample
from cqrun.errors import SceneError, UsageError
from cqrun.geometry.lattice import Lattice
from cqrun.geometry.mesh import Mesh
from cqrun.scene.load import load_scene

MESHES = Path(__file__).parents[2] / "scenes" / "robots" / "meshes"


def block(size: tuple[float, float, float], at: tuple[float, float, float] = (0, 0, 0), *, inward: bool = False) -> Any:
    """Return a box of 768 faces around a place."""
    box = trimesh.creation.box(size).subdivide().subdivide().subdivide()
    box.apply_translation(at)
    if inward:
        box.invert()
    return box


def opened(box: Any) -> Any:
    """Return a box without its side in direction x."""
    side = box.triangles_center[:, 0] > box.bounds[1, 0] - 1e-6
    return trimesh.Trimesh(box.vertices, box.faces[~side], process=False)


OUTER = block((100, 20, 20))
INNER = (60.0, 14.0, 14.0)
HALF = (30.0, 14.0, 14.0)


def mesh(path: Path, *bodies: Any, **fields: Any) -> Mesh:
    trimesh.util.concatenate(list(bodies)).export(path)
    return Mesh.model_validate({"file": str(path), "units": "mm", **fields})


def told(body: Mesh) -> str:
    """Return the refusal of a mesh, after its path."""
    with pytest.raises(UsageError) as info:
        body.examine()
    return str(info.value).partition(".stl: ")[2]


def hints(body: Mesh) -> list[str]:
    return [warning.partition(".stl: ")[2] for warning in body.examine()]


MIDDLE, WALL, AWAY = np.array([[0.0, 0.0, 0.0]]), np.array([[0.04, 0.0, 0.0]]), np.array([[0.06, 0.0, 0.0]])
TURN = "; if it should be material, turn its normals outward"
OUTWARD = (
    "lies inside another one and counts as a cavity, though the normals point out of it; if there should be material "
    "inside, delete the inner shell"
)


@pytest.mark.parametrize("inward", [True, False])
@pytest.mark.parametrize("outer", [True, False])
def test_a_shell_inside_another_is_a_cavity_whichever_way_both_point(outer: bool, inward: bool, tmp_path: Path) -> None:
    body = mesh(tmp_path / "a.stl", block((100, 20, 20), inward=not outer), block(INNER, inward=inward))
    assert hints(body) == [f"1 of its 2 shells {OUTWARD}"] * (outer != inward)
    assert body.inside(np.concatenate([MIDDLE, WALL, AWAY])).tolist() == [False, True, False]
    assert body.volume() == pytest.approx(28240e-9, rel=1e-6)


def test_a_mesh_that_is_inside_out_is_turned(tmp_path: Path) -> None:
    body = mesh(tmp_path / "a.stl", block((100, 20, 20), inward=True))
    assert hints(body) == []
    assert body.volume() == pytest.approx(40000e-9, rel=1e-6)


@pytest.mark.parametrize("inward", [True, False])
def test_an_inner_shell_that_is_open_is_an_error(inward: bool, tmp_path: Path) -> None:
    message = (
        "an inner shell has a hole at (30, 0, 0), of about 6% of its surface: a cavity must be closed; close its holes"
    )
    assert told(mesh(tmp_path / "a.stl", OUTER, opened(block(INNER, inward=inward)))) == message
    small = told(mesh(tmp_path / "b.stl", OUTER, opened(block((10, 10, 10), inward=inward))))  # not taken for a sheet
    assert small.startswith("an inner shell has a hole at (5, 0, 0), of about 20% of its surface")


def test_a_small_hole_of_an_inner_shell_is_closed(tmp_path: Path) -> None:
    inner = block(INNER, inward=True)
    holed = trimesh.Trimesh(inner.vertices, inner.faces[1:], process=False)
    body = mesh(tmp_path / "a.stl", OUTER, holed)
    assert hints(body) == ["has holes; the winding number decides what is inside"]
    assert body.inside(np.concatenate([MIDDLE, WALL])).tolist() == [False, True]


def test_an_inner_shell_through_the_outer_skin_is_an_error(tmp_path: Path) -> None:
    assert told(mesh(tmp_path / "a.stl", OUTER, block(INNER, (0, 0, 5), inward=True))) == (
        "a shell whose faces point inward passes through another one at (5, -4.667, 12): a cavity must lie inside"
        + TURN
    )
    through = told(mesh(tmp_path / "b.stl", OUTER, block((60, 14, 30), inward=True)))
    assert through.startswith("a shell whose faces point inward passes through another one at (")


def test_a_bar_through_a_body_is_found_although_its_corners_are_outside(tmp_path: Path) -> None:
    bar = trimesh.creation.box((4, 4, 60))
    bar.invert()
    assert "a shell whose faces point inward passes through another one at (" in told(
        mesh(tmp_path / "a.stl", OUTER, bar)
    )


def test_a_shell_through_the_skin_that_points_outward_is_joined_with_a_warning(tmp_path: Path) -> None:
    body = mesh(tmp_path / "a.stl", OUTER, block(INNER, (0, 0, 5)))
    assert hints(body) == [
        "a shell lies mostly inside another one, but passes through it at (5, -4.667, 12): both are joined; if it "
        "should be a cavity, let it lie inside",
        "surfaces overlap; they are joined",
    ]
    assert body.inside(MIDDLE).all()


@pytest.mark.parametrize("inward", [True, False])
def test_inner_shells_that_overlap_are_one_cavity(inward: bool, tmp_path: Path) -> None:
    halves = [block(HALF, (x, 0, 0), inward=inward) for x in (-10, 10)]
    body = mesh(tmp_path / "a.stl", OUTER, *halves)
    *_, last = hints(body)
    assert last == "inner shells overlap, such as at (-16.25, 2.333, -7); they count as one cavity"
    assert body.inside(np.array([[0, 0, 0], [0.02, 0, 0], [-0.02, 0, 0], [0.03, 0, 0]])).tolist() == [False] * 3 + [
        True
    ]


@pytest.mark.parametrize("inward", [True, False])
def test_inner_shells_that_meet_are_an_error(inward: bool, tmp_path: Path) -> None:
    alike = [block(HALF, (x, 0, 0), inward=inward) for x in (-15, 15)]
    assert told(mesh(tmp_path / "a.stl", OUTER, *alike)).startswith("a wall has no thickness at (0, ")
    other = block((30, 10, 10), (15, 1, 1), inward=inward)  # its corners are not those of the first
    assert told(mesh(tmp_path / "b.stl", OUTER, alike[0], other)).startswith("two cavities meet at (0, ")


@pytest.mark.parametrize("inward", [True, False])
def test_a_cavity_without_a_wall_is_an_error(inward: bool, tmp_path: Path) -> None:
    body = mesh(tmp_path / "a.stl", OUTER, block(INNER, (0, 0, 3), inward=inward))
    assert told(body) == "a cavity touches the outer surface at (0, 0, 10): it has no wall there; leave one"


def test_a_body_inside_a_cavity_may_touch_its_wall(tmp_path: Path) -> None:
    body = mesh(tmp_path / "a.stl", OUTER, block(INNER, inward=True), block((10, 10, 10), (0, 0, -2)))
    assert body.examine() == []
    assert body.inside(MIDDLE).all()


def test_a_rib_that_crosses_the_wall_of_a_cavity_is_material(tmp_path: Path) -> None:
    body = mesh(tmp_path / "a.stl", OUTER, block(INNER, inward=True), block((4, 18, 18), (1, 0, 0)))
    body.examine()
    assert body.inside(np.array([[0.001, 0, 0], [0.02, 0, 0]])).tolist() == [True, False]


# --- several files ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("inward", [True, False])
def test_cavities_are_cut_out_of_a_body(inward: bool, tmp_path: Path) -> None:
    for name, x in (("left", -20.0), ("right", 20.0)):
        block(HALF, (x, 0, 0), inward=inward).export(tmp_path / f"{name}.stl")
    files = [str(tmp_path / f"{name}.stl") for name in ("left", "right")]
    body = mesh(tmp_path / "a.stl", OUTER, cavities=files, offset=[0.1, 0.1, 0.1])
    assert body.examine() == []
    x = np.array([[-0.02, 0, 0], [0.02, 0, 0], [0, 0, 0], [0.04, 0, 0], [0.06, 0, 0]]) + 0.1
    assert body.inside(x).tolist() == [False, False, True, True, False]
    assert body.volume() == pytest.approx(28240e-9, rel=1e-6)
    assert body.bounds()[0] == pytest.approx([0.05, 0.09, 0.09])
    _, volume = Lattice().sample(body, 0.001)
    assert volume.sum() == pytest.approx(28240e-9, rel=1e-6)


def test_cavities_that_do_not_lie_inside_are_errors(tmp_path: Path) -> None:
    cavity = tmp_path / "c.stl"

    def refused(inner: Any) -> str:
        inner.export(cavity)
        return told(mesh(tmp_path / "a.stl", OUTER, cavities=[str(cavity)]))

    assert refused(block(HALF, (0, 0, 30))) == (
        "this cavity, from (-15, -7, 23) to (15, 7, 37), lies outside a.stl, from (-50, -10, -10) to (50, 10, 10): "
        "export both in the same coordinates and the same unit"
    )
    assert "a cavity must lie inside" in refused(block(INNER, (0, 0, 5)))
    assert "a cavity touches the outer surface at (0, 0, 10)" in refused(block(INNER, (0, 0, 3)))
    assert refused(opened(block((10, 10, 10)))) == (
        "an inner shell has a hole at (5, 0, 0), of about 20% of its surface: a cavity must be closed; close its holes"
    )
    assert refused(block((120, 14, 14))).startswith("a shell whose faces point inward passes through another one at (")


def test_a_cavity_that_is_no_file_is_told_at_its_place(tmp_path: Path) -> None:
    OUTER.export(tmp_path / "a.stl")
    shape = {"mesh": {"file": str(tmp_path / "a.stl"), "units": "mm", "cavities": [str(tmp_path / "none.stl")]}}
    material = {"density": 900.0, "elastic": {"neo_hookean": {"youngs_modulus": 1.0e4, "poissons_ratio": 0.3}}}
    body = {"shape": shape, "place": {"offset": [0.1, 0.1, 0.1]}, "spacing": 0.005, "material": material}
    scene = load_scene({
        "cqrun": 1, "world": {"size": [0.2, 0.2, 0.2], "dx": 0.01}, "bodies": {"a": body},
        "time": {"duration": 0.01, "control_step": 0.01},
    })  # fmt: skip
    with pytest.raises(SceneError) as info:
        sample(scene)
    assert [problem.path for problem in info.value.problems] == ["bodies.a.shape.mesh.cavities.0"]


def test_units_and_cavities_do_not_change_the_names_of_runs_without_them() -> None:
    assert set(Mesh(file="a.stl").model_dump()) & {"units", "cavities"} == set()


@pytest.mark.parametrize(("units", "factor"), [("m", 1.0), ("cm", 0.01), ("mm", 1e-3), ("in", 0.0254)])
def test_a_file_is_read_in_its_unit(units: str, factor: float, tmp_path: Path) -> None:
    body = mesh(tmp_path / "a.stl", OUTER, units=units, offset=[1.0, 2.0, 3.0], rotation=[0.0, 0.0, 90.0], scale=2.0)
    assert np.ptp(body.bounds(), axis=0).ravel() == pytest.approx(np.array([40, 200, 40]) * factor)
    assert body.volume() == pytest.approx(8 * 40000 * factor**3)
    middle = np.array([[1.0, 2.0 + 95 * factor, 3.0], [1.0, 2.0 + 105 * factor, 3.0]])
    assert body.inside(middle).tolist() == [True, False]
    moved, growth = body.carried(middle, body.model_copy(update={"scale": 3.0}))
    assert moved == pytest.approx([1.0, 2.0, 3.0] + 1.5 * (middle - [1.0, 2.0, 3.0]))
    assert growth == pytest.approx(1.5**3)


# --- the mesh of a scene ------------------------------------------------------------------------------------


def test_the_actuator_has_one_cavity_and_agrees_with_its_script() -> None:
    script = runpy.run_path(str(MESHES / "make_meshes.py"))
    file = MESHES / "pneunet.stl"
    assert file.stat().st_size < 100_000
    surface = trimesh.load_mesh(file)
    np.testing.assert_allclose(surface.triangles, script["surface"](*script["pneunet"]()), atol=1e-5)
    assert surface.is_watertight
    outer, inner = sorted((abs(part.volume) for part in surface.split()), reverse=True)
    assert outer == pytest.approx(100 * 20 * 7 + 4 * 20 * 13 + 7 * 12 * 20 * 13)
    assert inner == pytest.approx(7 * 8 * 16 * 15 + 6 * 6 * 4 * 2)
    body = Mesh(file=str(file), units="mm")
    assert body.examine() == []
    assert body.volume() == pytest.approx((outer - inner) * 1e-9)


@pytest.mark.parametrize("chambers", [1, 3, 8])
def test_any_number_of_chambers_is_one_cavity(chambers: int, tmp_path: Path) -> None:
    script = runpy.run_path(str(MESHES / "make_meshes.py"))
    script["write_stl"](tmp_path / "a.stl", script["surface"](*script["pneunet"](chambers=chambers, wall=1.5)))
    surface = trimesh.load_mesh(tmp_path / "a.stl")
    assert surface.is_watertight
    assert surface.body_count == 2
