"""Triangles from STL, OBJ and PLY: vertices at the same place are one, and files that are not whole are refused."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from cqrun.errors import UsageError
from cqrun.geometry.mesh_file import read_triangles

BOX = trimesh.creation.box((1, 1, 1))


def stl(body: Any) -> str:
    return str(body.export(file_type="stl_ascii"))


def refusal(path: Path, content: bytes | str) -> str:
    """Return why a file with some content is refused."""
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(UsageError) as info:
        read_triangles(path)
    assert str(info.value).startswith(f"{path}: ")
    return str(info.value).removeprefix(f"{path}: ")


@pytest.mark.parametrize("suffix", [".obj", ".ply"])
def test_seams_of_textures_and_normals_do_not_split_a_surface(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"seams{suffix}"
    corners = BOX.triangles.reshape(-1, 3)  # every face has corners of its own
    if suffix == ".obj":
        lines = [f"v {x} {y} {z}\nvt {0.01 * k} 0.5\nvn 0 0 {k}" for k, (x, y, z) in enumerate(corners)]
        faces = [f"f {a}/{a}/{a} {a + 1}/{a + 1}/{a + 1} {a + 2}/{a + 2}/{a + 2}" for a in range(1, len(corners), 3)]
        path.write_text("\n".join(["mtllib none.mtl", *lines, "usemtl skin", *faces]))
    else:
        rows = [f"{x} {y} {z} {0.01 * k} 0.5" for k, (x, y, z) in enumerate(corners)]
        rows += [f"3 {a} {a + 1} {a + 2}" for a in range(0, len(corners), 3)]
        head = ["ply", "format ascii 1.0", "comment TextureFile none.png", f"element vertex {len(corners)}"]
        head += [f"property float {name}" for name in "xyzst"]
        head += [f"element face {len(BOX.faces)}", "property list uchar int vertex_indices", "end_header"]
        path.write_text("\n".join([*head, *rows, ""]))
    vertices, faces = read_triangles(path)
    assert (len(vertices), len(faces)) == (8, 12)


def test_what_is_not_read_is_not_printed(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "part.mtl").write_text("newmtl skin\nmap_Kd none.png\n")
    (tmp_path / "part.obj").write_text("mtllib part.mtl\nusemtl skin\n" + str(BOX.export(file_type="obj")))
    ply = str(BOX.export(file_type="ply", encoding="ascii"), "utf-8")
    (tmp_path / "part.ply").write_text(ply.replace("\nelement", "\ncomment TextureFile none.png\nelement", 1))
    (tmp_path / "normals.stl").write_text(stl(BOX).replace("facet normal 0", "facet normal 0,"))
    handlers, logging.getLogger().handlers = logging.getLogger().handlers, []  # as outside of pytest
    try:
        for name in ("part.obj", "part.ply", "normals.stl"):
            assert len(read_triangles(tmp_path / name)[1]) == 12
    finally:
        logging.getLogger().handlers = handlers
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(("name", "text"), [("part.stl", stl(BOX)), ("part.obj", BOX.export(file_type="obj"))])
def test_decimal_commas_are_named(name: str, text: str, tmp_path: Path) -> None:
    assert refusal(tmp_path / name, text.replace(".", ",")) == (
        "its numbers have decimal commas; save it with decimal points"
    )


def test_binary_stl_may_begin_like_a_text_file(tmp_path: Path) -> None:
    data = b"solid of some program".ljust(80) + BOX.export(file_type="stl")[80:]
    (tmp_path / "solid.stl").write_bytes(data)
    assert len(read_triangles(tmp_path / "solid.stl")[1]) == 12
    for content, words in [
        (data[:300], "announces 12 triangles of 50 bytes, but has 216 bytes of them"),
        (data + bytes(100), "but has 700 bytes of them: its number is wrong, or something else follows"),
        (data[:80] + b"\xff\xff\xff\x7f" + data[84:], "announces 2,147,483,647 triangles of 50 bytes, but has 600"),
        (data[:80] + bytes(4) + data[84:], "announces 0 triangles of 50 bytes, but has 600 bytes of them"),
    ]:
        message = refusal(tmp_path / "solid.stl", content)
        assert message.startswith("is a binary STL file, though it begins with `solid` as text files do, that ann")
        assert words in message
        assert "though" not in refusal(tmp_path / "other.stl", b"\0other" + content[6:])


def test_text_stl_of_several_solids_is_one_surface(tmp_path: Path) -> None:
    other = BOX.copy()
    other.apply_translation([3, 0, 0])
    text = stl(BOX).replace("solid ", "solid vertex 1 solid", 1) + stl(other)
    (tmp_path / "two.stl").write_text(text)
    vertices, faces = read_triangles(tmp_path / "two.stl")
    assert (len(vertices), len(faces)) == (16, 24)
    assert np.ptp(vertices[:, 0]) == pytest.approx(4.0)


def test_files_that_are_cut_short_are_named(tmp_path: Path) -> None:
    text = stl(BOX)
    assert "ends without `endsolid`: it was cut short" in refusal(tmp_path / "cut.stl", text[: len(text) // 2])
    assert "ends without `endsolid`: it was cut short" in refusal(tmp_path / "cut.stl", text + text[: len(text) // 2])
    ply = BOX.export(file_type="ply", encoding="ascii").rstrip()
    lines = ply.split(b"\n")
    message = refusal(tmp_path / "cut.ply", b"\n".join(lines[:-3]) + b"\n")
    assert message == "announces 20 lines of points and faces, but has 17: it was cut short; save it again"
    huge = ply.replace(b"element vertex 8", b"element vertex 800000000000000000")
    assert refusal(tmp_path / "cut.ply", huge).startswith("announces 800,000,000,000,000,012 lines")


def test_binary_ply_that_announces_too_much_is_refused(tmp_path: Path) -> None:
    ply = BOX.export(file_type="ply")
    for count in (9, 10**12):
        content = ply.replace(b"element vertex 8", b"element vertex %d" % count)
        assert "cannot be read as PLY" in refusal(tmp_path / "part.ply", content)


def test_points_that_are_not_there_are_refused(tmp_path: Path) -> None:
    ply = BOX.export(file_type="ply", encoding="ascii").rstrip()
    for index in (b"-1", b"8"):
        content = ply[: ply.rindex(b" ")] + b" " + index + b"\n"
        assert refusal(tmp_path / "part.ply", content) == "its faces name points that are not there: it has 8"


def test_points_that_cannot_be_are_refused(tmp_path: Path) -> None:
    obj = BOX.export(file_type="obj")
    first = next(line for line in obj.splitlines() if line.startswith("v "))
    for point, words in [
        ("v 0.5 0.5", "one of its points has only 2 coordinates; save it again"),
        ("v 0.5 0.5 1e12", "one of its points lies 1e+12 from the origin; at most 1e+09 can be read"),
        ("v 0.5 0.5 nan", "1 of its points are not finite"),
    ]:
        assert refusal(tmp_path / "part.obj", obj.replace(first, point)) == words


def test_indices_that_count_back_are_read_only_where_that_is_safe(tmp_path: Path) -> None:
    points = "".join(f"v {x} {y} {z}\n" for x, y, z in BOX.vertices)
    faces = "".join("f " + " ".join(str(k - 8) for k in face) + "\n" for face in BOX.faces)
    (tmp_path / "one.obj").write_text(points + faces)
    assert len(read_triangles(tmp_path / "one.obj")[1]) == 12
    message = refusal(tmp_path / "two.obj", 2 * (points + faces))
    assert message.startswith("counts points back from its faces (negative indices), which cannot be read here")


def test_triangles_without_area_are_left_out(tmp_path: Path) -> None:
    line = trimesh.Trimesh(BOX.vertices, np.concatenate([BOX.faces, [[0, 0, 1], [2, 2, 2]]]), process=False)
    line.export(tmp_path / "line.ply")
    assert len(read_triangles(tmp_path / "line.ply")[1]) == 12


def test_file_too_large_for_the_memory_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    BOX.export(tmp_path / "part.stl")
    monkeypatch.setattr("cqrun.geometry.mesh_file._MEMORY", 2**50)
    with pytest.raises(
        UsageError, match=r"part\.stl: reading it needs about .* TiB; .* are free: save it with fewer tr"
    ):
        read_triangles(tmp_path / "part.stl")
