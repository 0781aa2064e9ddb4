"""`cqrun codesign --ablate` and `--seeds`: variants of a design, the rates that suit them, gains and effects."""

from __future__ import annotations

import csv
import json
import signal
from pathlib import Path

import numpy as np
import pytest
from small_beam import Listener, changed, result_of
from small_finger import DESIGN, FINGER, written
from typer.testing import CliRunner

from cqrun.cli.app import app
from cqrun.errors import RunError, SceneError, Stopped, UsageError
from cqrun.figures.ablation import draw_ablation
from cqrun.jobs.control import CODESIGN
from cqrun.jobs.studies import ablation, members
from cqrun.jobs.studies.ablation import _gain, ablation_lines, effects, run_ablation
from cqrun.jobs.studies.seeds import run_seeds
from cqrun.jobs.studies.variants import group_of, variants_of
from cqrun.running.fleet import Member
from cqrun.scene.load import load_scene
from cqrun.scene.paths import get
from cqrun.scene.unknowns import tied
from cqrun.store.history import read_history
from cqrun.store.run import read_record

E, NU, RHO = (f"bodies.finger.material.{name}" for name in (
    "elastic.fixed_corotated.youngs_modulus", "elastic.fixed_corotated.poissons_ratio", "density",
))  # fmt: skip
BOUNDS = {E: "[5, 20]", NU: "[0.2, 0.4]", RHO: "[0.5, 2]"}


def design(tmp_path, *paths: str):
    """Write the small finger, shorter still, with a number a particle of each path."""
    path = tmp_path / "finger.yaml"
    unknowns = "".join(f"  {p}: {{bounds: {BOUNDS[p]}, per: particle}}\n" for p in paths)
    path.write_text(FINGER.replace("job: control", "job: codesign") + f"unknowns:\n{unknowns}")
    changed(path, "max_iterations: 4", "max_iterations: 2")
    return changed(path, "duration: 0.1", "duration: 0.04")


def test_variants_are_all_combinations_of_three_groups(tmp_path):
    found = variants_of(load_scene(design(tmp_path, E, NU, RHO)))
    assert [v.name for v in found] == [
        "control", "youngs_modulus", "poissons_ratio", "density", "youngs_modulus + poissons_ratio",
        "youngs_modulus + density", "poissons_ratio + density", "all",
    ]  # fmt: skip
    assert found[0].overrides == tuple(f"unknowns.{path}=null" for path in (E, NU, RHO))
    assert found[1].overrides == tuple(f"unknowns.{path}=null" for path in (NU, RHO))
    assert (found[0].job.name, found[7].job.name, found[7].overrides) == ("control", "codesign", ())
    assert group_of("bodies.arm.shape.box.size.1") == "size"


def test_what_is_fixed_stays_where_its_unknown_starts(tmp_path):
    path = design(tmp_path, E, NU)
    scene = load_scene(
        path,
        [
            f"unknowns.{E}.initial=20",
            f"unknowns.{NU}={{bounds: [0.1, 0.4], also: {{{RHO}: {{factor: 2, offset: 1}}}}}}",
        ],
    )
    control, *_, free = variants_of(scene)
    assert control.overrides == (f"unknowns.{E}=null", f"unknowns.{NU}=null", f"{E}=20.0", f"{RHO}=1.6")
    fixed = load_scene(path, control.overrides)
    assert (get(fixed, E), get(fixed, RHO), fixed.unknowns) == (20.0, 1.6, {})
    assert free.overrides == ()


def test_effects_and_gains_of_a_known_design(tmp_path):
    """2 + 3 a - b + .5 a b: freeing a adds 3.25 in the mean, b takes .75."""
    variants = variants_of(load_scene(design(tmp_path, E, RHO)))
    values = {v.name: [2 + 3 * a - b + 0.5 * a * b + shift for shift in (0.0, 0.1)]
              for v in variants for a, b in [(E.split(".")[-1] in v.groups, "density" in v.groups)]}  # fmt: skip
    added = effects({frozenset(v.groups): np.array(values[v.name]) for v in variants})
    assert added["youngs_modulus"] == pytest.approx([3.25, 3.25])
    assert added["density"] == pytest.approx([-0.75, -0.75])  # the shift is of both sides
    assert _gain([3.0, 5.0], [2.0, 2.0], -1.0).mean == pytest.approx(1.0)  # greater is better
    assert _gain([1.0, 1.5], [2.0, 3.0], 1.0).mean == pytest.approx(0.5)  # smaller is better: still a gain
    assert _gain([1.0], [0.0], -1.0) is None


def test_variants_are_learned_and_compared(tmp_path, monkeypatch):
    scene, listener = design(tmp_path, E), Listener()
    path, good = run_ablation(scene, [], tmp_path / "out", threads=2, seeds=2, rates=[0.1, 1e-6], reporter=listener)
    assert good
    result = json.loads(path.read_text())
    assert listener.said[-2:] == [
        "trying 2 learning rates with 2 variants, 2 at once",
        "learning 2 variants from 2 seeds, 2 at once; 2 of 4 runs are there already",  # trials of the better rate
    ]
    assert (result["compared"], result["better"]) == ("tip", "smaller")
    for name, entry in result["variants"].items():
        assert entry["rate"] == "0.1"  # the other hardly moves
        assert entry["searched"]["0.1"] < entry["searched"]["1e-06"]
        runs = [result_of(Path(run)) for run in entry["runs"]]
        assert [run["job"] for run in runs] == ["control" if name == "control" else "codesign"] * 2
        mean = sum(run["trained"]["terms"]["tip"] for run in runs) / 2
        assert entry["terms"]["tip"]["mean"] == pytest.approx(mean, rel=1e-12)
    free, alone = (result["variants"][name]["terms"]["tip"]["mean"] for name in ("youngs_modulus", "control"))
    assert result["effects"]["youngs_modulus"]["mean"] == pytest.approx(free - alone, rel=1e-9)
    rows = list(csv.DictReader(path.with_suffix(".csv").read_text().splitlines()))
    assert [row["variant"] for row in rows] == ["control", "youngs_modulus"]
    # the same command again starts no process, neither for trials nor for runs
    with monkeypatch.context() as patch:
        patch.setattr(Member, "start", None)
        assert run_ablation(scene, [], tmp_path / "out", threads=2, seeds=2, rates=[0.1, 1e-6]) == (path, True)
    assert json.loads(path.read_text()) == result
    assert draw_ablation(path)[0].stat().st_size > 10_000
    text = "\n".join(ablation_lines(path))
    assert text.startswith("2 variants from 2 seeds; mean and 90% interval; smaller is better")
    assert "freeing it adds" in text
    assert "failed" not in text
    result["variants"]["control"]["searched"]["1e-06"] = None
    path.write_text(json.dumps(result))
    assert "note: control failed with rate 1e-06" in ablation_lines(path)


@pytest.mark.slow
@pytest.mark.usefixtures("in_process")
def test_variants_that_cannot_meet_their_constraints_are_told(tmp_path):
    """The tip comes to .0146 with the stiffness free, and to .0158 without."""
    scene, listener = written(tmp_path, DESIGN), Listener()
    path, _ = run_ablation(
        scene, ["constraints.tip.at_most=0.0152", "controller.linear_tanh.spread=0",
                "unknowns.bodies.finger.material.density={bounds: [0.999, 1.001]}"],
        tmp_path / "out", threads=2, seeds=2, reporter=listener,
    )  # fmt: skip
    assert any("all runs will be the same" in line for line in listener.said)
    variants = json.loads(path.read_text())["variants"]
    assert {name: entry["feasible"] for name, entry in variants.items()} == {
        "control": 0, "youngs_modulus": 2, "density": 0, "all": 2,
    }  # fmt: skip
    assert all(entry["gain"] is None for entry in variants.values())
    assert variants["youngs_modulus"]["constraints"]["tip"]["mean"] <= 0.0152 + 1e-8
    assert variants["control"]["constraints"]["tip"]["mean"] > 0.0152
    rows = list(csv.DictReader(path.with_suffix(".csv").read_text().splitlines()))
    assert [row["feasible"] for row in rows] == ["0", "2", "0", "2"]
    assert float(rows[0]["constraint:tip:mean"]) > 0.0152
    text = "\n".join(ablation_lines(path))
    assert "0 of 2" in text
    assert "freeing it adds" in text  # the density, to the stiffness
    assert draw_ablation(path)[0].stat().st_size > 10_000
    one, other = (Path(run) for run in variants["youngs_modulus"]["runs"])
    result = result_of(one)
    trained = result["trained"]
    trained["terms"] = {name: value + 9.0 for name, value in trained["terms"].items()}
    (one / "result.json").write_text(json.dumps(result | {"status": "infeasible", "trained": trained}))
    members = {"youngs_modulus": [Member(run.name, run, [], 1) for run in (one, other)]}
    loaded = load_scene(scene)
    (variant,) = (v for v in variants_of(loaded) if v.name == "youngs_modulus")
    means = ablation.summary("finger", loaded, [variant], members).variants["youngs_modulus"].terms
    assert {name: mean.mean for name, mean in means.items()} == result_of(other)["trained"]["terms"]


@pytest.mark.slow
@pytest.mark.usefixtures("in_process")
def test_that_no_run_meets_the_constraints_is_a_failure(tmp_path):
    scene = written(tmp_path, DESIGN)
    given = ["constraints.tip.at_most=0.001", "unknowns.bodies.finger.material.density={bounds: [0.999, 1.001]}"]
    path, good = run_ablation(scene, given, tmp_path / "out", threads=2, seeds=1)
    assert not good
    text = "\n".join(ablation_lines(path))
    assert "variants from one seed;" in text
    assert "no run of any variant meets the constraints" in text


@pytest.mark.slow
@pytest.mark.usefixtures("pictures")
def test_runs_that_blow_up_leave_the_comparison_of_the_others(tmp_path):
    """With bounds of stiffness up to 10^7 Pa, no step of the least length that is tried is stable."""
    scene = changed(design(tmp_path, E, RHO), f"{E}: {{bounds: [5, 20]", f"{E}: {{bounds: [5, 1.0e+7]")
    told = CliRunner().invoke(app, ["codesign", str(scene), "--ablate", "--seeds", "1", "--out", str(tmp_path / "out")])
    assert told.exit_code == 1
    (path,) = tmp_path.glob("out/finger/ablation-*.json")
    result = json.loads(path.read_text())
    assert {name: len(entry["failed"]) for name, entry in result["variants"].items()} == {
        "control": 0, "youngs_modulus": 1, "density": 0, "all": 1,
    }  # fmt: skip
    free = result["variants"]["youngs_modulus"]
    assert (free["gain"], free["terms"]["tip"]["mean"]) == (None, None)
    assert list(result["effects"]) == ["density"]
    assert result["variants"]["density"]["gain"]["mean"] == pytest.approx(
        -result["effects"]["density"]["mean"] / result["variants"]["control"]["terms"]["tip"]["mean"], rel=1e-9
    )
    lines = told.output.splitlines()
    (run_of_all,) = result["variants"]["all"]["runs"]
    assert any(line.split() == ["youngs_modulus", "failed"] for line in lines)
    assert any(line.startswith(f"all, seed 0 failed: {run_of_all}: body") and "left the grid" in line for line in lines)
    assert path.with_suffix(".png").stat().st_size > 10_000
    (run,) = map(Path, free["runs"])  # as where the start itself blows up
    (run / "history.csv").write_text((run / "history.csv").read_text().partition("\n")[0] + "\n")
    assert draw_ablation(path)
    rows = list(csv.DictReader(path.with_suffix(".csv").read_text().splitlines()))
    assert [row["tip:mean"] != "" for row in rows] == [True, False, True, False]


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        ("objective={}", {}, "this scene has no `objective`"),
        ("unknowns={}", {}, "this scene has no `unknowns`"),
        ("optimizer={lbfgs: {}}", {"rates": [0.1]}, "the scene's optimizer, lbfgs, has no learning_rate"),
        ("time.duration=0.04", {"seeds": 0}, "--seeds 0: must be at least 1"),
    ],
)
def test_what_cannot_be_compared(tmp_path, change, options, message):
    with pytest.raises(UsageError, match=message):
        run_ablation(design(tmp_path, E), [change], tmp_path / "out", threads=1, **{"seeds": 1, **options})


@pytest.mark.usefixtures("in_process")
def test_seeds_of_a_codesign(tmp_path):
    path, good = run_seeds(design(tmp_path, E), [], tmp_path / "out", threads=2, seeds=2, job=CODESIGN)
    assert good
    assert len(json.loads(path.read_text())["seeds"]) == len(list(path.parent.glob("*/result.json"))) == 2
    assert {read_record(run)["job"] for run in path.parent.glob("*/")} == {"codesign"}


@pytest.mark.usefixtures("in_process")
def test_variants_run_with_the_time_steps_of_the_whole(tmp_path):
    """`auto` would give control alone longer ones than stiffnesses that may reach 400: the starts are the same."""
    scene = design(tmp_path, E)
    changed(scene, f"{E}: {{bounds: [5, 20]", f"{E}: {{bounds: [5, 400]")
    path, _ = run_ablation(scene, ["time.substeps=auto"], tmp_path / "out", threads=1, seeds=1)
    runs = [Path(entry["runs"][0]) for entry in json.loads(path.read_text())["variants"].values()]
    steps = {load_scene(run / "scene.yaml").time.substeps for run in runs}
    assert len(steps) == 1
    assert steps.pop() > 1
    assert len({read_history(run / "history.csv")["tip"][0] for run in runs}) == 1


@pytest.mark.parametrize(
    ("path", "vector"),
    [("bodies.finger.velocity.0", [0.1, 0.0]), ("bodies.finger.spin.0", [0.1]), ("world.gravity.1", [0.0, 0.1])],
)
def test_a_vector_that_the_scene_leaves_out_stays_where_it_starts(tmp_path, path, vector):
    scene, free = design(tmp_path, E), [f"unknowns.{path}={{bounds: [-1, 1], initial: 0.1}}"]
    control = variants_of(load_scene(scene, free))[0]
    assert get(load_scene(scene, [*free, *control.overrides]), path.rpartition(".")[0]) == vector
    with pytest.raises(SceneError, match="there is no entry '7' in a list of"):
        load_scene(scene, [f"{path[:-1]}7=1"])


def test_what_follows_may_differ_from_the_scene_by_rounding(tmp_path):
    """Its particles stay those of the scene, to the bit."""
    height, over = (f"bodies.finger.parts.{part}" for part in ("left.box.size.1", "tip.box.corner.1"))
    tie = f"unknowns.{height}={{bounds: [1.95, 2.05], also: {{{over}: {{factor: 1.4, offset: -0.8}}}}}}"
    scene = load_scene(design(tmp_path, E), [tie])
    assert tied(scene, height, 2.0)[over] != get(scene, over)
    assert not any(override.startswith("bodies") for v in variants_of(scene) for override in v.overrides)


def test_a_start_that_is_another_body_is_refused(tmp_path):
    scene = load_scene(
        design(tmp_path, E), ["unknowns.bodies.finger.place.offset.0={bounds: [0.19, 0.25], initial: 0.22}"]
    )
    told = (
        "'bodies.finger.place.offset.0' starts at 0.22, but the scene has 0.2; .* -o bodies.finger.place.offset.0=0.22"
    )
    with pytest.raises(UsageError, match=told):
        variants_of(scene)
    same = ["bodies.finger.place.offset.0=0.22", "unknowns.bodies.finger.place.offset.0={bounds: [0.19, 0.25]}"]
    assert len(variants_of(load_scene(tmp_path / "finger.yaml", same))) == 4


def test_a_start_of_groups_that_is_not_the_scenes_is_refused(tmp_path):
    """Particles in no group have the scene's own value where the unknown is free, and the start where it is not."""
    scene = load_scene(design(tmp_path), [f"unknowns={{{E}: {{bounds: [5, 20], per: group, initial: 6}}}}"])
    with pytest.raises(UsageError, match=r"starts at 6, .* have other values in particles without a group"):
        variants_of(scene)


def test_stopped_it_says_of_how_many_seeds_it_can_compare_all(tmp_path, monkeypatch):
    """Variants are learned seed by seed: of two variants five runs are two seeds of each, and one more."""
    ended = 0

    def stopped(runs, at_once, what, talk):
        assert [run.name for run in runs[:3]] == ["control, seed 0", "youngs_modulus, seed 0", "control, seed 1"]
        for run in runs[ended:]:
            run.failure = "not begun"
        talk.stop.ask(signal.SIGINT)

    monkeypatch.setattr(members, "run_fleet", stopped)
    for ended, now in ((1, ""), (5, "; with --seeds 2 it compares the finished runs")):
        told = rf"^SIGINT \(Ctrl-C\): {ended} of 6 runs are finished; the same command continues{now}$"
        with pytest.raises(Stopped, match=told):
            run_ablation(design(tmp_path, E), [], tmp_path / "out", threads=2, seeds=3)


@pytest.mark.slow
def test_a_trial_that_was_killed_is_no_rate_that_fails(tmp_path, monkeypatch):
    """The command ends, and goes on when repeated."""
    scene = design(tmp_path, E)
    begin = Member.start

    def start(self):
        begin(self)
        if not (tmp_path / "killed").exists():
            (tmp_path / "killed").touch()
            self.process.kill()

    monkeypatch.setattr(Member, "start", start)
    who = r"control, seed 0 with optimizer.adam.learning_rate=0.1 \(.*/out/finger/[0-9a-f]{12}\)"
    told = rf"1 of 4 trials failed; {who}: was killed \(SIGKILL\); the same command goes on with it"
    with pytest.raises(RunError, match=told):
        run_ablation(scene, [], tmp_path / "out", threads=2, seeds=1, rates=[0.1, 1e-6])
    path, _ = run_ablation(scene, [], tmp_path / "out", threads=2, seeds=1, rates=[0.1, 1e-6])
    assert all(None not in entry["searched"].values() for entry in json.loads(path.read_text())["variants"].values())
