"""Families of figures: what they draw and judge of walkers and their materials, and the curves behind them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from benchmarks.papers.catalogue import FIGURES
from benchmarks.papers.families import integrity
from benchmarks.papers.families.ablations import ORDER, Ablation
from benchmarks.papers.families.distances import Distances
from benchmarks.papers.families.histories import Run, curves, ended_or_all, first_below, moving_mean
from benchmarks.papers.figure import Judgement, Size, read_table, table_of, write_table
from benchmarks.papers.machinery.archive import TEXT
from cqrun.figures.style import styled
from cqrun.store.atomic import write_json

INTACT = {"fracture": 0.0, "least_volume_ratio": 0.5}
"""In the last row of a seed whose body holds together in its best motion."""


def not_intact(table):
    """Return the table with torn bodies, with inverted particles, without records of that, and without one seed's."""
    last = np.flatnonzero(np.isfinite(table["fracture"]))
    some = table["fracture"].copy()
    some[last[0]] = np.nan
    none = {name: column for name, column in table.items() if name not in INTACT}
    torn, inverted = table["fracture"] + 0.01, table["least_volume_ratio"] - 0.6
    return {**table, "fracture": torn}, {**table, "least_volume_ratio": inverted}, none, {**table, "fracture": some}


@pytest.mark.parametrize("figure", [f for f in FIGURES.values() if isinstance(f, Distances)], ids=lambda f: f.id)
@pytest.mark.parametrize("size", Size)
def test_distances_are_drawn_and_judged(figure, size):
    """Two seeds of every variant that the size has; they walk as far as the paper's, and hold together or do not."""
    labels = [variant.label for variant in figure.variants if size in variant.seeds]
    far = 0.5 * figure.final
    rows = [
        {"variant": label, "seed": seed, "iteration": k, "seconds": 9.0 * k, "value": far * k + 0.01 * seed}
        | (INTACT if k == 2 else {})
        for label in labels for seed in range(2) for k in range(3)
    ]  # fmt: skip
    table = table_of(iter(rows))
    assert figure.judge(table, size).judgement is Judgement.MET
    flew = {**table, "value": 9.0 * table["value"]}
    if size is Size.PAPER:
        assert figure.judge(flew, size).judgement is Judgement.EXCEEDED
    for changed in not_intact(flew):
        assert figure.judge(changed, size).judgement is Judgement.PARTLY
    stood = {**table, "value": 0.0 * table["value"]}  # it holds together, which does not make up for it
    assert figure.judge(stood, size).judgement is Judgement.MISSED
    with styled():
        (axes,) = figure.draw(table, size, {}).axes
    ticks = {tick: label.get_text() for tick, label in zip(axes.get_xticks(), axes.get_xticklabels(), strict=True)}
    assert ticks[2] == f"2\n{18 if axes.get_xlabel().endswith('[s]') else 0.3}"  # where ours end
    assert ticks[figure.iterations] == f"{figure.iterations}\n"
    marks = next(line for line in axes.lines if line.get_label().startswith("paper, after"))
    assert list(marks.get_ydata()) == [figure.start, figure.final]


@pytest.mark.parametrize(
    ("name", "last", "found"),
    [("cq2_fig11", 0.0, [True]), ("cq2_fig11", 1e-3, [True]), ("cq2_fig11", -1.0, [False]), ("cq2_fig14", 0.0, [])],
)
def test_equal_printed_values_have_no_order(name, last, found):
    """In the biped's plot nu adds as much as mass, as far as it can be read, and E adds more.

    In the octopod's plot all values are too near each other, and no order is asked for.
    """
    far = dict(zip(ORDER, FIGURES[name].printed, strict=True))
    far["E"] += last
    rows = [{"variant": v, "seed": s, "iteration": 0, "value": far[v], "seconds": 0.0} for v in ORDER for s in (0, 1)]
    checks = FIGURES[name].judge(table_of(iter(rows)), Size.PAPER).checks
    assert [met for text, met in checks.items() if text.startswith("what each adds")] == found


@pytest.mark.parametrize("figure", [f for f in FIGURES.values() if isinstance(f, Ablation)], ids=lambda f: f.id)
@pytest.mark.parametrize("size", Size)
def test_ablations_are_drawn_and_judged(figure, size):
    """Two seeds of every combination; they walk as far as the paper's, then all as far as control alone."""
    fewer = size is Size.PAPER and figure.particles
    best, beyond = (Judgement.PARTLY, Judgement.PARTLY) if fewer else (Judgement.MET, Judgement.EXCEEDED)
    rows = [
        {"variant": label, "seed": seed, "iteration": k, "seconds": 9.0 * k, "value": 0.5 * far * k + 1e-3 * seed}
        | (INTACT if k == 2 and label in (ORDER[0], ORDER[-1]) else {})
        for label, far in zip(ORDER, figure.printed, strict=True) for seed in range(2) for k in range(3)
    ]  # fmt: skip
    table = table_of(iter(rows))
    assert figure.judge(table, size).judgement is best
    for changed in not_intact(table):
        assert figure.judge(changed, size).judgement is Judgement.PARTLY
    first = table["value"][table["variant"] == ORDER[0]]
    same = {**table, "value": np.tile(first, len(ORDER))}
    assert figure.judge(same, size).judgement is not Judgement.MET
    with styled():
        left, right = figure.draw(table, size, {}).axes
    far = {**table, "value": np.where(table["variant"] == ORDER[0], 1.0, 1.3) * table["value"]}
    short = {**table, "value": 0.1 * table["value"]}
    if size is Size.PAPER:
        assert figure.judge(far, size).judgement is beyond
        # a gain counts only where control alone comes as far as the paper's
        assert figure.judge(short, size).judgement is Judgement.MISSED
        nearly = {**table, "value": 0.97 * table["value"]}  # seeds are a millimetre apart: so is their interval
        assert figure.judge(nearly, size).judgement is Judgement.MISSED
    lacking = {name: column[(table["variant"] != ORDER[-1]) | (table["seed"] == 0)] for name, column in table.items()}
    assert figure.judge(lacking, size).judgement is best  # a seed that blew up in one variant is not compared
    none = {name: column[table["variant"] != ORDER[-1]] for name, column in table.items()}
    assert figure.judge(none, size).judgement is Judgement.MISSED
    assert "wall time of 'all' [s]" in left.get_xlabel()
    (legend,) = right.get_legend().get_texts()
    assert (legend.get_text() == "paper") == (size is Size.PAPER)


def test_an_unfinished_ablation_shows_the_runs_that_ended(tmp_path):
    """An ablation takes hours, and cqrun writes its table only in the end."""
    E, nu = (f"bodies.biped.material.elastic.neo_hookean.{name}" for name in ("youngs_modulus", "poissons_ratio"))
    mass = "bodies.biped.material.density"
    begun = ((), "done"), ((nu, E), "iteration_limit"), ((E, nu, mass), "stalled"), ((E,), "stopped"), ((nu,), "failed")
    for k, (free, status) in enumerate(begun):
        run = tmp_path / "biped_codesign" / str(k)
        run.mkdir(parents=True)
        write_json(run / "run.json", {"status": status, "seconds": 5.0, "seed": 3})
        (run / "scene.yaml").write_text(yaml.safe_dump({"unknowns": {path: {} for path in free}}))
        (run / "history.csv").write_text(f"iteration,far,seconds\n0,0.5,2\n1,{k},5\n")
    table = FIGURES["cq2_fig11"].table({"biped_codesign": tmp_path}, Size.PAPER)
    assert list(dict.fromkeys(table["variant"])) == ["control", "E + nu", "all"]
    assert {*table["seed"]} == {3}
    np.testing.assert_array_equal(table["value"], [0.5, 0, 0.5, 1, 0.5, 2])
    np.testing.assert_array_equal(table["seconds"], [0, 3] * 3)


def test_a_torn_or_inverted_or_unrecorded_body_is_not_intact():
    crawler = FIGURES["cq1_crawler"]
    path = {"time": np.arange(2.0), **dict(zip("xyz", np.array([[0.7, 1.4], [0.2, 0.4], [0.5, 0.5]]), strict=True))}

    def judgement(**watched: float) -> Judgement:
        return crawler.judge(path | {name: np.full(2, value) for name, value in watched.items()}, Size.PAPER).judgement

    assert judgement(fracture=0.0, least_volume_ratio=0.1) is Judgement.MET
    assert judgement(fracture=0.01, least_volume_ratio=0.1) is Judgement.PARTLY
    assert judgement(fracture=0.0, least_volume_ratio=-0.04) is Judgement.PARTLY
    assert judgement() is Judgement.PARTLY


def test_the_integrity_of_a_motion_is_noted_beside_the_run(tmp_path, monkeypatch):
    """Motions are not packed for other machines, but the note on a finished run is."""
    write_json(tmp_path / "run.json", {"status": "running", "seconds": 5.0})
    monkeypatch.setattr(integrity, "read_run", lambda run: run)
    seen = {"least_volume_ratio": np.array([0.9, 0.4]), "fracture": np.array([0.0, 0.2])}
    monkeypatch.setattr(integrity, "watch", lambda run, body: seen)
    found = {"least_volume_ratio": 0.4, "fracture": 0.2}
    assert integrity.worst(tmp_path, "a") == {}
    (tmp_path / "trajectory.h5").touch()
    assert integrity.worst(tmp_path, "a") == found
    assert not (tmp_path / integrity.NOTE).exists()  # it is not finished
    write_json(tmp_path / "run.json", {"status": "iteration_limit", "seconds": 5.0})
    assert integrity.worst(tmp_path, "a") == found
    seen["fracture"] = np.array([0.0, 0.3])  # run again, it moves differently
    found["fracture"] = 0.3
    assert integrity.worst(tmp_path, "a") == found
    (tmp_path / "trajectory.h5").unlink()
    assert integrity.worst(tmp_path, "a") == found
    assert (tmp_path / integrity.NOTE).suffix in TEXT


def test_volumes_that_are_not_numbers_are_not_intact():
    table = {"fracture": np.zeros(2), "least_volume_ratio": np.array([0.5, np.nan])}
    assert list(integrity.checks(table, 2).values()) == [True, False]


def test_a_table_comes_back(tmp_path):
    table = table_of(iter([{"name": "a, b", "x": 1.5}, {"name": "c", "y": 2.0}]))
    write_table(table, tmp_path / "t.csv")
    again = read_table(tmp_path / "t.csv")
    assert list(again["name"]) == ["a, b", "c"]
    np.testing.assert_array_equal(again["x"], [1.5, np.nan])
    np.testing.assert_array_equal(again["y"], [np.nan, 2.0])


def test_a_seed_that_has_ended_keeps_its_last_value():
    rows = [(0, 0, 1.0), (0, 1, 2.0), (1, 0, 3.0)]
    table = table_of(
        {"variant": "a", "seed": seed, "iteration": k, "seconds": float(k), "value": v} for seed, k, v in rows
    )
    found = curves(table, "a")
    np.testing.assert_array_equal(found.value, [[1.0, 2.0], [3.0, 3.0]])
    np.testing.assert_array_equal(found.mean, [2.0, 2.5])
    assert found.half[0] > 0


def test_means_over_a_window():
    np.testing.assert_allclose(moving_mean(np.array([1.0, 3.0, 5.0]), 2), [1.0, 2.0, 4.0])
    assert first_below(np.array([3.0, 1.0, 0.5]), 1.0) == 2
    assert first_below(np.array([3.0]), 1.0) is None


def test_an_unfinished_seed_is_not_used_beside_a_finished_one():
    runs = [Run(Path(), seed, {}, finished) for seed, finished in ((0, True), (1, False))]
    assert [run.seed for run in ended_or_all(runs)] == [0]
    assert ended_or_all(runs[1:]) == runs[1:]
