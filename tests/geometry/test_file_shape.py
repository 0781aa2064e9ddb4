"""Shapes from files: only regular files are read, and none that fills the memory."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from cqrun.build.particles import sample
from cqrun.errors import SceneError, UsageError
from cqrun.geometry.file_shape import FileShape, require_memory
from cqrun.geometry.image import Image
from cqrun.geometry.mesh import Mesh
from cqrun.scene.files import unreadable_files
from cqrun.scene.load import load_scene


@pytest.mark.parametrize(("kind", "fields"), [(Mesh, {}), (Image, {"height": 1.0})])
def test_pipe_folder_or_device_is_refused_without_waiting(
    kind: type[FileShape], fields: dict[str, float], tmp_path: Path
) -> None:
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "folder.png").mkdir()
    for name, why in [
        ("pipe.png", "it is a pipe or a device, not a file"),
        ("folder.png", "Is a directory"),
        ("/dev/zero", "it is a pipe or a device, not a file"),
        ("none.png", "No such file or directory"),
        ("a\0b.png", "its name has a zero byte"),
    ]:
        with pytest.raises(UsageError) as info:
            kind.model_validate({"file": str(tmp_path / name), **fields}).examine()
        assert f"cannot be read ({why}); the name starts from the scene's folder" in str(info.value)


def test_scene_that_names_a_pipe_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.png")
    scene = tmp_path / "scene.yaml"
    scene.write_text(
        """
cqrun: 1
world: {size: [1, 1], dx: 0.1, frame: updated}
bodies:
  a:
    shape: {image: {file: pipe.png, height: 1}}
    spacing: 0.05
    material: {density: 1000, elastic: {neo_hookean: {youngs_modulus: 1.0e4, poissons_ratio: 0.3}}}
time: {duration: 0.1, control_step: 0.1}
"""
    )
    (problem,) = unreadable_files(load_scene(scene), ("bodies",))
    assert "pipe.png: cannot be read (it is a pipe or a device, not a file)" in problem.message
    assert problem.where == f"{scene}:6:27"
    with pytest.raises(SceneError, match="it is a pipe or a device, not a file"):
        sample(load_scene(scene))


def test_memory_that_is_not_there_is_named() -> None:
    require_memory(Path("small.png"), 1, "make it smaller")
    with pytest.raises(UsageError, match=r"large\.png: reading it needs about .* TiB; .* are free: make it smaller"):
        require_memory(Path("large.png"), 2**60, "make it smaller")
