"""The papers' figures, as they are declared: what they say, and that their work can be run."""

from __future__ import annotations

from collections import defaultdict

import pytest

from benchmarks.papers.catalogue import FIGURES
from benchmarks.papers.figure import Judgement, Size
from benchmarks.papers.machinery.publish import publish
from benchmarks.papers.machinery.work import CLOCK, Runs
from cqrun.build.model import build
from cqrun.scene.load import load_scene
from cqrun.store.atomic import write_json

WORKS = {
    (figure.id, size, work.name): work for figure in FIGURES.values() for size in Size for work in figure.work(size)
}


QUICK_MINUTES = 60.0
"""The quick set takes no longer on two cores."""


@pytest.mark.parametrize("figure", FIGURES.values(), ids=list(FIGURES))
def test_a_figure_says_what_it_is(figure):
    for text in (figure.title, figure.source, figure.paper, *figure.tolerance.values()):
        assert text.strip()
    assert set(figure.tolerance) == set(Size)
    assert all(work.minutes > 0 for size in Size for work in figure.work(size))


@pytest.mark.parametrize(
    "work", [w for w in WORKS.values() if isinstance(w, Runs)], ids=lambda w: f"{w.name}-{w.fingerprint()[:6]}"
)
def test_what_is_run_can_be_built_and_is_stable(work):
    """A figure at quick size once asked for substeps at which its hills blow up."""
    scene = load_scene(work.path, list(work.overrides))
    assert scene.job == work.job or (scene.job, work.job) == ("codesign", "control")
    assert build(scene).model.n_steps > 0


@pytest.mark.parametrize(
    "work",
    [w for (i, size, _), w in WORKS.items() if isinstance(w, Runs) and size is Size.QUICK and i != "cq2_fracture"],
    ids=lambda w: f"{w.name}-{w.fingerprint()[:6]}",
)
def test_quick_bodies_have_particles_enough_to_hold_together(work):
    """A quick biped once came apart as it walked, and was called reproduced for how far its head flew."""
    warnings = [str(warning) for warning in build(load_scene(work.path, list(work.overrides))).warnings]
    assert not [warning for warning in warnings if "a body may break apart" in warning]


@pytest.mark.parametrize("size", Size)
@pytest.mark.parametrize("figure", FIGURES.values(), ids=list(FIGURES))
def test_work_that_is_hardly_begun_shows_nothing_and_ends_nothing(figure, size, tmp_path):
    """`make reproduce-figures MINUTES=1` once ended in a traceback, and without the figures after it."""
    for work in figure.work(size):
        (tmp_path / work.name).mkdir()
        write_json(tmp_path / work.name / CLOCK, {"fingerprint": work.fingerprint(), "engine": "none", "seconds": 1.0})
    verdict = publish(figure, size, tmp_path, tmp_path / "out")
    assert verdict is None or verdict.judgement is Judgement.UNFINISHED


def test_work_of_one_name_is_one_work():
    commands = defaultdict(set)
    for (_, size, name), work in WORKS.items():
        commands[size, name].add(work.command)
    assert [names for names, told in commands.items() if len(told) > 1] == []


def test_the_quick_set_is_quick():
    works = {work.name: work.minutes for (_, size, _), work in WORKS.items() if size is Size.QUICK}
    assert sum(works.values()) <= QUICK_MINUTES
