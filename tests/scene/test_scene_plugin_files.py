"""Plug-in files of a scene: run only if allowed, identified by their content, refused if they are wrong."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from plugin_sandbox import DISC, sandbox

from cqrun.errors import SceneError, UsageError
from cqrun.plugin import registry
from cqrun.scene.load import dump, load_scene, resolve
from cqrun.scene.paths import with_values
from cqrun.scene.plugin_files import load_plugin_files, plugins_allowed

SCENE = """\
cqrun: 1
plugins: [disc.py]
world: {size: [0.2, 0.1], dx: 0.005, frame: updated}
bodies:
  ball:
    shape: {disc: {middle: [0.1, 0.05], radius: 0.02}}
    particles_per_cell: 4
    material: {density: 1000, elastic: {fixed_corotated: {youngs_modulus: 1e5, poissons_ratio: 0.3}}}
time: {duration: 0.1, control_step: 0.01}
"""

ErrorOf = Callable[..., str]


@pytest.fixture(autouse=True)
def _sandbox() -> Iterator[None]:
    with sandbox():
        yield


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """Return a scene beside its plug-in file."""
    (tmp_path / "disc.py").write_text(DISC)
    (tmp_path / "scene.yaml").write_text(SCENE)
    return tmp_path / "scene.yaml"


@pytest.fixture
def error_of(scene: Path) -> ErrorOf:
    """Return a function that writes the plug-in file's text, loads the scene, and returns the error message."""

    def load(text: str | None = None, *overrides: str) -> str:
        if text is not None:
            (scene.parent / "disc.py").write_text(text)
        with plugins_allowed(), pytest.raises(SceneError) as info:
            load_scene(scene, overrides)
        assert info.value.exit_code == 2
        return str(info.value)

    return load


def test_without_permission_no_file_is_run(scene: Path, tmp_path: Path) -> None:
    (tmp_path / "disc.py").write_text(f"from pathlib import Path\nPath({str(tmp_path / 'ran')!r}).touch()\n" + DISC)
    with pytest.raises(SceneError) as info:
        load_scene(scene)
    assert str(info.value).startswith(f"{scene}:2:1: plugins: this scene wants to run Python files of its own: disc.py")
    for part in ("whatever you can", "delete your files", "--allow-plugins", "allow_plugins=True"):
        assert part in str(info.value)
    assert not (tmp_path / "ran").exists()
    with plugins_allowed(), plugins_allowed(False), pytest.raises(SceneError, match="wants to run"):
        load_scene(scene)
    with plugins_allowed():
        load_scene(scene)
    assert (tmp_path / "ran").exists()
    with pytest.raises(SceneError, match="wants to run"):  # permission ends with its context
        load_scene(scene)


def test_a_plug_in_is_a_part_of_a_scene_like_any_other(scene: Path) -> None:
    with plugins_allowed():
        loaded = load_scene(scene)
        shape = loaded.bodies["ball"].shape
        assert shape is not None
        assert (shape.name, shape.value.kind, shape.value.radius) == ("disc", "shape", 0.02)  # type: ignore[attr-defined]
        assert loaded.plugin_paths() == {"disc.py": scene.parent / "disc.py"}
        text = dump(resolve(loaded))
        assert dump(resolve(load_scene(text, (), scene.parent))) == text
    moved = with_values(loaded, {"bodies.ball.shape.disc.radius": 0.01})
    assert moved.bodies["ball"].shape.value.radius == 0.01  # type: ignore[union-attr]
    assert "disc" in registry.plugins("shape")


def test_errors_in_its_fields_have_their_position(scene: Path) -> None:
    scene.write_text(SCENE.replace("0.02}", "-0.02}"))
    place = r"scene.yaml:6:49: bodies.ball.shape.disc.radius: must be greater"
    with plugins_allowed(), pytest.raises(SceneError, match=place):
        load_scene(scene)


def test_a_scene_without_plug_ins_has_none(beam: str) -> None:
    assert resolve(load_scene(beam))["plugins"] == []
    assert load_scene(beam).plugin_paths() == {}


RAISES = DISC.replace("@plugin", "table = {}\nvalue = table['missing']\n\n@plugin", 1)


LAW = '''\
from typing import ClassVar

from cqrun.plugin.contract import quantity
from cqrun.materials.term import MaterialTerm
from cqrun.plugin.registry import plugin


@plugin("elastic", "own_law")
class OwnLaw(MaterialTerm):
    """A law that does not use one of its numbers."""

    parameters: ClassVar[tuple[str, ...]] = ("youngs_modulus",)
    youngs_modulus: float = quantity("Pa", "Young's modulus", differentiable=True, gt=0)
    hardening: float = quantity("1", "Hardening", differentiable=True, default=0.0)
'''
"""A kernel plug-in that declares a number differentiable that its kernels do not use."""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (LAW, "class OwnLaw, elastic 'own_law', declares hardening differentiable, which no gradient reaches: for "),
        (RAISES, "disc.py:11: raises KeyError: 'missing'; in the line: value = table['missing']"),
        ("import numpy as np\n\ndef f(:\n", "disc.py:3: raises SyntaxError: invalid syntax; in the line: def f(:"),
        ("import sys\nsys.exit('no')\n", "disc.py:2: raises SystemExit: no"),
        ("import none_of_this\n", "disc.py:1: raises ModuleNotFoundError: No module named 'none_of_this'"),
        ("", "disc.py registers no plug-in: decorate a class with @plugin(kind, name) of cqrun.plugin.registry"),
        (DISC.replace('"disc"', '"ball"'), "disc.py:10: raises ValueError: two plug-ins of kind 'shape' are called"),
        (DISC.replace('"shape"', '"shapes"'), "raises ValueError: unknown kind of plug-in 'shapes'; kinds are shape, "),
        (DISC.replace("(Shape)", ""), "class Disc is registered as shape 'disc' and must derive from the same base "),
        (DISC.replace("def inside", "def within"), "class Disc, shape 'disc', lacks methods: inside"),
    ],
)
def test_the_error_of_an_unusable_file_names_its_line(text: str, message: str, error_of: ErrorOf) -> None:
    known = dict(registry.plugins("shape"))
    answer = error_of(text)
    assert "scene.yaml:2:11: plugins.0: " in answer
    assert message in answer
    assert "\n" not in answer
    assert registry.plugins("shape") == known


def test_a_class_with_the_name_of_a_built_in_plug_in_is_refused(error_of: ErrorOf) -> None:
    text = DISC.replace('"disc"', '"ball"').replace("class Disc", "class Ball")
    assert "two plug-ins of kind 'shape' are called 'ball'; the other is in " in error_of(text)
    assert registry.plugins("shape")["ball"].__module__ == "cqrun.geometry.ball"


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ("[none.py]", "plugins.0: there is no file '{folder}/none.py'; a name is relative to the scene's folder"),
        ("[disc.txt]", "plugins.0: 'disc.txt' is not a Python file: its name must end in .py"),
        ("[disc.py, ./disc.py]", "plugins.1: two files are called 'disc.py'; a run keeps them in one folder: rename"),
        ("[disc.py, twin.py]", "plugins.1: {folder}/twin.py:10: raises ValueError: two plug-ins of kind 'shape' are"),
        ("disc.py", "plugins: must be a list, is 'disc.py'"),
        ("[3]", "plugins.0: must be text, is 3"),
    ],
)
def test_invalid_file_names_are_refused(names: str, message: str, error_of: ErrorOf, scene: Path) -> None:
    for name in ("disc.txt", "twin.py"):
        (scene.parent / name).write_text(DISC)
    assert f"-o plugins={names}: {message.format(folder=scene.parent)}" in error_of(None, f"plugins={names}")


def test_a_changed_file_is_another_module(scene: Path) -> None:
    with plugins_allowed():
        first = load_scene(scene)
        (scene.parent / "disc.py").write_text(DISC.replace("<= self", "<  self"))  # as long, at the same second
        second = load_scene(scene)
        assert type(second.bodies["ball"].shape.value) is registry.plugins("shape")["disc"]  # type: ignore[union-attr]
        assert type(first.bodies["ball"].shape.value).__module__ != registry.plugins("shape")["disc"].__module__  # type: ignore[union-attr]
        (scene.parent / "disc.py").write_text(DISC)
        third = load_scene(scene)  # and back
    assert type(third.bodies["ball"].shape.value) is type(first.bodies["ball"].shape.value)  # type: ignore[union-attr]


def test_a_copy_is_the_same_module(scene: Path, tmp_path: Path) -> None:
    with plugins_allowed():
        first = load_scene(scene)
        run = tmp_path / "run"
        (run / "plugins").mkdir(parents=True)
        (run / "plugins" / "disc.py").write_text(DISC)
        (run / "scene.yaml").write_text(dump(resolve(first)))
        (scene.parent / "disc.py").unlink()
        kept = load_scene(run / "scene.yaml", (), scene.parent)  # as a run loads it
    assert kept.plugin_paths() == {"disc.py": run / "plugins" / "disc.py"}
    assert type(kept.bodies["ball"].shape.value) is type(first.bodies["ball"].shape.value)  # type: ignore[union-attr]


def test_explicitly_named_files_need_no_scene(scene: Path) -> None:
    load_plugin_files([scene.parent / "disc.py"])
    assert "disc" in registry.plugins("shape")
    with pytest.raises(UsageError, match=r"none.py: cannot be read \(No such file or directory\)"):
        load_plugin_files([scene.parent / "none.py"])


def test_a_file_has_its_own_future_imports_and_its_own_name(scene: Path, error_of: ErrorOf) -> None:
    """Annotations are evaluated as the file specifies, not as in the module of the loader."""
    (scene.parent / "disc.py").write_text(DISC + "\nassert Disc.inside.__annotations__ == {}\nx: int = 1\n"
                                          "assert __annotations__ == {'x': int}, __annotations__\n"
                                          f"assert __file__ == {str(scene.parent / 'disc.py')!r}\n")  # fmt: skip
    with plugins_allowed():
        load_scene(scene)
