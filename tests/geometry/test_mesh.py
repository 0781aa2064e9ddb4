"""Meshes: points that a surface encloses, also with holes and overlaps, and surfaces that are refused."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from cqrun.errors import MissingExtra, UsageError
from cqrun.geometry.lattice import Lattice
from cqrun.geometry.mesh import Mesh
from cqrun.geometry.skin import make_skin


@pytest.fixture
def sphere() -> Any:
    """Return a unit sphere with 1280 faces."""
    return trimesh.creation.icosphere(subdivisions=3)


def saved(surface: Any, path: Path, **fields: Any) -> Mesh:
    surface.export(path)
    return Mesh.model_validate({"file": str(path), **fields})


def without(surface: Any, gone: np.ndarray) -> Any:
    surface.update_faces(~gone)
    return surface


def as_given(vertices: np.ndarray, faces: np.ndarray) -> Any:
    return trimesh.Trimesh(vertices, faces, process=False)


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply", ".STL"])
def test_sphere_is_a_ball(suffix: str, sphere: Any, tmp_path: Path, rng: np.random.Generator) -> None:
    body = saved(sphere, tmp_path / "ball.stl", scale=0.5, offset=[1.0, 2.0, 3.0])
    if suffix != ".stl":
        sphere.export(tmp_path / f"ball{suffix.lower()}")
        (tmp_path / f"ball{suffix.lower()}").rename(tmp_path / f"again{suffix}")
        body = Mesh(file=str(tmp_path / f"again{suffix}"), scale=0.5, offset=[1.0, 2.0, 3.0])
    assert body.examine() == []
    x = rng.uniform(-1, 1, (5000, 3)) * 0.6 + [1.0, 2.0, 3.0]
    r = np.linalg.norm(x - [1.0, 2.0, 3.0], axis=1)
    inside = body.inside(x)
    assert inside[r < 0.49].all()
    assert not inside[r > 0.5].any()
    assert body.volume() == pytest.approx(4 / 3 * np.pi * 0.125, rel=0.02)
    assert body.bounds()[0] == pytest.approx([0.5, 1.5, 2.5], abs=1e-6)
    assert body.bounds()[1] == pytest.approx([1.5, 2.5, 3.5], abs=1e-6)


def test_rotated_box_is_filled_like_a_box(tmp_path: Path) -> None:
    box = saved(trimesh.creation.box((0.4, 0.2, 0.1)), tmp_path / "box.ply", rotation=[0.0, 0.0, 90.0])
    points, volume = Lattice().sample(box, 0.05)
    assert len(points) == 8 * 4 * 2
    assert np.ptp(points, axis=0) == pytest.approx([0.15, 0.35, 0.05])
    assert volume.sum() == pytest.approx(box.volume()) == pytest.approx(0.008)


def test_small_holes_are_closed(sphere: Any, tmp_path: Path, rng: np.random.Generator) -> None:
    body = saved(without(sphere, rng.random(1280) < 0.1), tmp_path / "holes.stl")
    assert body.examine() == [f"{tmp_path / 'holes.stl'}: has holes; the winding number decides what is inside"]
    x = rng.uniform(-1.2, 1.2, (5000, 3))
    r = np.linalg.norm(x, axis=1)
    inside = body.inside(x)
    assert inside[r < 0.9].all()
    assert not inside[r > 1.1].any()
    assert body.volume() == pytest.approx(4 / 3 * np.pi, rel=0.03)


def test_mesh_that_is_inside_out_is_turned(sphere: Any, tmp_path: Path) -> None:
    sphere.invert()
    body = saved(sphere, tmp_path / "out.ply")
    assert body.examine() == []
    assert body.inside(np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])).tolist() == [True, False]
    assert body.volume() > 4


def test_surfaces_that_overlap_are_joined(sphere: Any, tmp_path: Path) -> None:
    other = sphere.copy()
    other.apply_translation([1.0, 0.0, 0.0])
    body = saved(trimesh.util.concatenate([sphere, other]), tmp_path / "two.ply")
    assert body.examine() == [f"{tmp_path / 'two.ply'}: surfaces overlap; they are joined"]
    assert body.inside(np.array([[0.5, 0.0, 0.0], [-0.5, 0.0, 0.0], [1.5, 0.0, 0.0]])).all()
    lens = np.pi * (4 + 1) * (2 - 1) ** 2 / 12  # of two unit balls a distance 1 apart
    assert body.volume() == pytest.approx(8 / 3 * np.pi - lens, rel=0.02)


def test_faces_that_are_turned_over_are_turned_back(sphere: Any, tmp_path: Path) -> None:
    flipped = sphere.faces.copy()
    flipped[::3] = flipped[::3, ::-1]
    body = saved(as_given(sphere.vertices, flipped), tmp_path / "mixed.ply")
    (warning,) = body.examine()
    assert warning.endswith(
        "mixed.ply: 427 of its 1,280 faces were turned over against the others; they are turned back"
    )
    assert body.volume() == pytest.approx(sphere.volume, rel=1e-6)
    assert len(Lattice().sample(body, 0.2)[0]) == len(Lattice().sample(saved(sphere, tmp_path / "whole.ply"), 0.2)[0])


def test_open_surface_is_an_error(sphere: Any, tmp_path: Path) -> None:
    bowl = saved(without(sphere.copy(), sphere.triangles_center[:, 2] > 0), tmp_path / "bowl.stl")
    with pytest.raises(UsageError, match=r"bowl\.stl: has holes: for \d\d% of what it encloses, .*; close its holes"):
        bowl.examine()


def test_sheet_is_an_error(tmp_path: Path) -> None:
    x, y = np.meshgrid(np.linspace(0, 1, 5), np.linspace(0, 1, 5))
    vertices = np.stack([x, y, 0.2 * x * y], axis=-1).reshape(-1, 3)
    corner = np.array([5 * j + i for j in range(4) for i in range(4)])
    faces = np.concatenate([corner[:, None] + [0, 1, 6], corner[:, None] + [0, 6, 5]])
    with pytest.raises(UsageError, match=r"sheet\.obj: encloses nothing: it is a sheet"):
        saved(as_given(vertices, faces), tmp_path / "sheet.obj").examine()
    with pytest.raises(UsageError, match=r"flat\.obj: is flat, so it encloses nothing"):
        saved(as_given(vertices * [1, 1, 0], faces), tmp_path / "flat.obj").examine()


def test_surface_that_crosses_itself_is_an_error(sphere: Any, tmp_path: Path) -> None:
    # an hourglass drawn as a figure of eight: its lower half is turned inside out
    eight = sphere.vertices * np.stack([sphere.vertices[:, 2], np.ones(642), np.ones(642)], axis=1)
    with pytest.raises(UsageError, match=r"eight\.ply: crosses itself, or is inside out in parts: \d+% as much"):
        saved(as_given(eight, sphere.faces), tmp_path / "eight.ply").examine()


def test_surface_that_crosses_itself_a_little_gives_a_warning(sphere: Any, tmp_path: Path) -> None:
    pulled = sphere.vertices.copy()
    pulled[np.linalg.norm(pulled - [0.0, 0.0, 1.0], axis=1) < 0.25] *= [1.0, 1.0, -1.5]  # through the far side
    (warning,) = saved(as_given(pulled, sphere.faces), tmp_path / "pulled.ply").examine()
    assert "pulled.ply: crosses itself, or is inside out in parts: " in warning
    assert warning.endswith(" is enclosed the wrong way round (at (0.04167, 0.125, -1.038)), and is left out")


@pytest.mark.parametrize("suffix", [".stl", ".obj"])
def test_name_in_latin_1_is_read(suffix: str, sphere: Any, tmp_path: Path) -> None:
    if suffix == ".stl":
        text = sphere.export(file_type="stl_ascii").replace("solid", "solid Körper", 1)
    else:
        text = "# Körper\n" + sphere.export(file_type="obj")
    path = tmp_path / f"latin{suffix}"
    path.write_bytes(text.encode("latin-1"))
    assert Mesh(file=str(path)).examine() == []


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("text.stl", b"no mesh at all", "text.stl: holds no triangle; is it a surface in the format STL"),
        ("empty.stl", b"solid a\nendsolid a\n", "empty.stl: holds no triangle"),
        ("none.stl", b"", "none.stl: holds no triangle"),
        ("points.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 1\n", "points.obj: holds no triangle"),
        ("text.ply", b"no mesh at all", "text.ply: cannot be read as PLY ("),
        ("beyond.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 1\nf 1 2 9\n", "beyond.obj: cannot be read as OBJ ("),
        (
            "nan.obj",
            b"v 0 0 0\nv nan 0 0\nv 0 1 1\nf 1 2 3\n",
            "nan.obj: 1 of its points are not finite",
        ),
        ("body.step", b"ISO-10303-21;", "body.step: a mesh is read from .stl, .obj, .ply"),
    ],
)
def test_files_without_a_mesh_are_errors(name: str, content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UsageError) as info:
        Mesh(file=str(tmp_path / name)).examine()
    assert message in str(info.value)


def test_truncated_file_is_an_error(sphere: Any, tmp_path: Path) -> None:
    for suffix in (".stl", ".ply"):
        sphere.export(tmp_path / f"whole{suffix}")
        cut = tmp_path / f"cut{suffix}"
        cut.write_bytes((tmp_path / f"whole{suffix}").read_bytes()[:3000])
        with pytest.raises(UsageError, match=f"cut\\{suffix}: (is a binary STL file|cannot be read)"):
            Mesh(file=str(cut)).examine()
    with pytest.raises(UsageError, match=r"absent\.stl: cannot be read \(No such file"):
        Mesh(file=str(tmp_path / "absent.stl")).examine()


def test_error_names_the_missing_extra(sphere: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sphere.export(tmp_path / "ball.stl")
    monkeypatch.setitem(sys.modules, "igl", None)
    with pytest.raises(MissingExtra, match=r"a mesh needs igl, which is not installed: pip install 'cqrun\[mesh\]'"):
        Mesh(file=str(tmp_path / "ball.stl")).examine()


def test_mesh_needs_a_3d_world() -> None:
    assert "a mesh needs a 3D world" in Mesh(file="a.stl").dim_problems(2)[0][1]
    assert Mesh(file="a.stl", rotation=[0.0, 0.0, 9.0]).dim_problems(3) == []
    assert Mesh(file="a.stl", angle=9.0).dim_problems(3)[0][0] == ("angle",)


@pytest.mark.parametrize("cut", [False, True], ids=["closed", "with a cavity"])
def test_distances_find_the_surface_that_inside_finds(cut, tmp_path):
    """A turned and scaled box: signs, normals, and the points of its skin."""
    box = trimesh.creation.box((0.4, 0.2, 0.1))
    hollow = trimesh.creation.box((0.2, 0.1, 0.04))
    surface = trimesh.util.concatenate([box, hollow]) if cut else box
    body = saved(surface, tmp_path / "box.stl", rotation=[10.0, 20.0, 30.0], scale=2.0, offset=[1.0, 0.0, 0.0])
    x = np.random.default_rng(1).uniform(-0.5, 0.5, (500, 3)) + np.array([1.0, 0.0, 0.0])
    found = body.distance(x)
    assert found is not None
    distance, normal = found
    assert np.array_equal(distance < 0, body.inside(x))
    assert np.linalg.norm(normal, axis=1) == pytest.approx(1.0)
    near = np.abs(distance) < 0.02
    ahead = body.distance(x[near] + 1e-3 * normal[near])
    assert ahead is not None
    assert np.median(np.abs(ahead[0] - distance[near] - 1e-3)) < 1e-9  # but for edges, and places between two faces
    given, plain = (make_skin(body.inside, *body.bounds(), 0.04, way) for way in (body.distance, None))
    assert given.x == pytest.approx(plain.x, abs=4e-5)
    assert given.area.sum() == pytest.approx(plain.area.sum(), rel=1e-4)


def test_an_open_mesh_has_no_distance(sphere, tmp_path):
    holed = without(sphere, np.arange(len(sphere.faces)) < 3)
    assert saved(holed, tmp_path / "holed.stl").distance(np.zeros((1, 3))) is None
