"""The papers' figures, as they are declared: what they say, and that their tasks can be run."""

from __future__ import annotations

import ast
from collections import defaultdict
from graphlib import TopologicalSorter

import pytest

from benchmarks.papers.catalogue import FIGURES
from benchmarks.papers.figure import Judgement, Size
from benchmarks.papers.machinery.process import ROOT
from benchmarks.papers.machinery.publish import Publication
from benchmarks.papers.machinery.runs import Runs
from benchmarks.papers.machinery.task import CLOCK
from cqrun.build.model import build
from cqrun.scene.load import load_scene
from cqrun.store.atomic import write_json

PAPERS = ROOT / "benchmarks" / "papers"
TASKS = {
    (figure.id, size, task.name): task for figure in FIGURES.values() for size in Size for task in figure.tasks(size)
}


QUICK_MINUTES = 60.0
"""All quick figures take no longer on two cores."""


@pytest.mark.parametrize("figure", FIGURES.values(), ids=list(FIGURES))
def test_a_figure_says_what_it_is(figure):
    for text in (figure.title, figure.source, figure.paper, *figure.criteria.values()):
        assert text.strip()
    assert set(figure.criteria) == set(Size)
    assert all(task.minutes > 0 for size in Size for task in figure.tasks(size))


@pytest.mark.parametrize(
    "task", [w for w in TASKS.values() if isinstance(w, Runs)], ids=lambda w: f"{w.name}-{w.fingerprint()[:6]}"
)
def test_scenes_can_be_built_and_are_stable(task):
    """A quick figure once had substeps at which its hills blow up."""
    scene = load_scene(task.path, list(task.overrides))
    assert scene.job == task.job or (scene.job, task.job) == ("codesign", "control")
    assert build(scene).model.n_steps > 0


@pytest.mark.parametrize(
    "task",
    [w for (i, size, _), w in TASKS.items() if isinstance(w, Runs) and size is Size.QUICK and i != "cq2_fracture"],
    ids=lambda w: f"{w.name}-{w.fingerprint()[:6]}",
)
def test_quick_bodies_have_enough_particles_to_hold_together(task):
    """A quick biped once broke apart, and its figure was reproduced because its head flew far."""
    assert not warns_of_breaking(task)


def test_a_body_with_too_few_particles_is_noticed():
    """The bar of one particle a cell, which is meant to tear."""
    assert warns_of_breaking(TASKS["cq2_fracture", Size.QUICK, "tear_1"])


def warns_of_breaking(task):
    warnings = [str(warning) for warning in build(load_scene(task.path, list(task.overrides))).warnings]
    return any("a body may break apart" in warning for warning in warnings)


@pytest.mark.parametrize("size", Size)
@pytest.mark.parametrize("figure", FIGURES.values(), ids=list(FIGURES))
def test_a_task_that_has_hardly_begun_shows_nothing_and_stops_nothing(figure, size, tmp_path):
    """`make reproduce-figures MINUTES=1` once ended with a traceback, and without the figures after it."""
    for task in figure.tasks(size):
        (tmp_path / task.name).mkdir()
        write_json(tmp_path / task.name / CLOCK, {"fingerprint": task.fingerprint(), "engine": "none", "seconds": 1.0})
    verdict = Publication(figure, size, tmp_path / "out").publish(tmp_path)
    assert verdict is None or verdict.judgement is Judgement.UNFINISHED


def test_tasks_with_the_same_name_are_the_same():
    commands = defaultdict(set)
    for (_, size, name), task in TASKS.items():
        commands[size, name].add(task.command)
    assert [name for name, same in commands.items() if len(same) > 1] == []


def test_the_quick_set_is_quick():
    minutes = {task.name: task.minutes for (_, size, _), task in TASKS.items() if size is Size.QUICK}
    assert sum(minutes.values()) <= QUICK_MINUTES


def test_machinery_knows_no_figure_and_nothing_imports_in_a_circle():
    """Figures import families and machinery, families import machinery, and machinery imports neither."""
    imports = {path: set(imported(path)) for path in PAPERS.rglob("*.py")}
    rooms = {"machinery": {"machinery"}, "families": {"machinery", "families"}}
    for path, names in imports.items():
        allowed = rooms.get(path.parent.name, {"machinery", "families", "figures"})
        assert {name.parent.name for name in names} & {"machinery", "families", "figures"} <= allowed, path
    TopologicalSorter(imports).prepare()  # raises an error if there is a circle


def imported(path):
    """Yield the files of benchmarks/papers that a file imports, also inside functions."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("benchmarks.papers"):
            for name in (node.module, *(f"{node.module}.{alias.name}" for alias in node.names)):
                file = PAPERS.parents[1] / (name.replace(".", "/") + ".py")
                if file.exists():
                    yield file
