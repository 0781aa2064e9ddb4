"""Whatever is in a scene, cqrun takes it or says what is wrong and where: no traceback, nothing huge, nothing slow."""

from __future__ import annotations

import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path

import judge
import numpy as np
import pytest
from extremes import EXTREMES, numeric_fields
from harness import LARGE, all_scenes, faults
from mutations import mutated, mutated_override

from cqrun.errors import Problem, SceneError
from cqrun.plugin.contract import Plugin
from cqrun.plugin.registry import FOLDERS, plugins
from cqrun.scene.document import read
from cqrun.scene.load import load_scene
from cqrun.scene.walk import parts

SEED = 45

FEW = 100
"""Number of mutated scenes in the short test."""

MANY, CHUNK = 10_000, 500
"""Number of mutated scenes in the long test, and in one test of it."""


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return all_scenes(tmp_path_factory.mktemp("scenes"))


def mutants(scenes: Sequence[Path], seeds: range) -> Iterator[tuple[str, str]]:
    """Yield a name and the text of a mutated scene for every seed; one in twenty is of a large scene."""
    small = [path for path in scenes if not path.name.startswith(LARGE)]
    for seed in seeds:
        rng = np.random.default_rng([SEED, seed])
        of = scenes if rng.random() < 0.05 else small
        path = of[rng.integers(len(of))]
        yield f"{path.stem}-{seed}", mutated(path.read_text(), rng)


def test_the_scenes_have_every_plug_in_and_are_valid(scenes: list[Path]) -> None:
    found = {type(part) for path in scenes for _, part in parts(load_scene(path))}
    registered = {cls for kind in FOLDERS for cls in plugins(kind).values() if cls.__module__.startswith("cqrun.")}
    assert registered <= {cls for cls in found if issubclass(cls, Plugin)}


def test_a_hundred_mutated_scenes_are_valid_or_refused_with_their_place(scenes: list[Path]) -> None:
    few = [path for path in scenes if not path.name.startswith((*LARGE, "plane"))]
    assert faults(scenes[0].parent, mutants(few, range(FEW))) == []


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, MANY, CHUNK))
def test_mutated_scenes_are_valid_or_refused_with_their_place(scenes: list[Path], first: int) -> None:
    assert faults(scenes[0].parent, mutants(scenes, range(first, first + CHUNK))) == []


def _fault_of_overrides(path: Path, seeds: range) -> list[str]:
    """Return what is wrong with how a scene takes mutated overrides."""
    data, found = read(path.read_text()).data, []
    for seed in seeds:
        rng = np.random.default_rng([SEED, 1, seed])
        overrides = [mutated_override(data, rng) for _ in range(int(rng.integers(1, 3)))]
        try:
            load_scene(path, overrides)
        except SceneError as error:
            lines = str(error).splitlines()
            if not all(line.startswith((f"{path}:", "-o ")) and line.isprintable() for line in lines):
                found.append(f"{overrides}: {error}")
        except Exception:
            found.append(f"{overrides}: {traceback.format_exc()}")
    return found


def test_overrides_are_taken_or_refused_by_name(scenes: list[Path]) -> None:
    assert [fault for path in scenes[:3] for fault in _fault_of_overrides(path, range(20))] == []


@pytest.mark.slow
def test_many_overrides_are_taken_or_refused_by_name(scenes: list[Path]) -> None:
    assert [fault for path in scenes for fault in _fault_of_overrides(path, range(250))] == []


def test_some_fields_with_extreme_numbers(scenes: list[Path]) -> None:
    fields = list(numeric_fields(path for path in scenes if not path.name.startswith(LARGE)))
    assert len(fields) > 200
    few = [(f"extreme{k}", f.text(EXTREMES[k % len(EXTREMES)])) for k, f in enumerate(fields) if k % 10 == 0]
    assert faults(scenes[0].parent, few) == []


@pytest.mark.slow
@pytest.mark.parametrize("k", range(len(EXTREMES)))
def test_every_numeric_field_with_extreme_numbers(scenes: list[Path], k: int) -> None:
    texts = ((f"{k}-{f.owner.__name__}-{f.name}", f.text(EXTREMES[k])) for f in numeric_fields(scenes))
    assert faults(scenes[0].parent, texts) == []


def _raises(error: Exception) -> Iterator[str]:
    raise error
    yield ""


@pytest.mark.parametrize(
    ("lines", "found"),
    [
        (lambda: iter(["a valid scene"]), ""),
        (lambda: _raises(SceneError([Problem("a.yaml:1:1", "x", "is wrong")])), ""),
        (lambda: _raises(SceneError([Problem("a.yaml", "x", "is wrong")])), ""),
        (lambda: _raises(SceneError([Problem("somewhere", "x", "is wrong")])), "an error without a place"),
        (lambda: _raises(SceneError([Problem("a.yaml:0:0", "x", "is wrong")])), "an error without a place"),
        (lambda: _raises(SceneError([])), "an error without a place"),
        (lambda: _raises(ValueError("math domain error")), "Traceback"),
        (lambda: _raises(MemoryError()), "Traceback"),
        (lambda: iter(["title \x1b[2J"]), "control characters"),
    ],
)
def test_the_judge_sees_what_is_wrong(monkeypatch: pytest.MonkeyPatch, lines, found: str) -> None:
    monkeypatch.setattr(judge, "validate", lambda _: lines())
    assert judge.fault(Path("a.yaml")).startswith(found)
    assert bool(judge.fault(Path("a.yaml"))) == bool(found)


def test_a_process_that_ends_is_a_fault_of_the_scene_it_was_at(scenes: list[Path], monkeypatch) -> None:
    monkeypatch.setattr("harness.SECONDS", 1e-3)  # less than any scene takes
    found = faults(scenes[0].parent, [("a", scenes[0].read_text()), ("b", scenes[0].read_text())])
    assert [line.partition("\n")[0] for line in found] == [f"{n}.yaml: the process ended: -27" for n in "ab"]
    assert all("cqrun/jobs/validate.py" in line for line in found)
