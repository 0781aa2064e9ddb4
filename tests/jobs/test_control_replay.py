"""`cqrun simulate RUN`: a trained controller acts again, as it was, longer, elsewhere and with another goal."""

from __future__ import annotations

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from small_beam import Listener, assert_same, changed, result_of
from small_finger import FINGER, written

import cqrun
from cqrun.build.model import build
from cqrun.controllers.saved import read_controller, save_controller
from cqrun.errors import SceneError, Stopped, UsageError
from cqrun.figures.render import RenderOptions, render
from cqrun.jobs.control import run_control
from cqrun.jobs.export import designed
from cqrun.jobs.resume import run_resume
from cqrun.jobs.simulate import UNTRAINED, run_simulate
from cqrun.jobs.table import report_lines
from cqrun.learning.agent import Agent
from cqrun.learning.keeping import Keeping
from cqrun.running.reporter import Silent
from cqrun.running.runs import open_run, scene_in
from cqrun.scene.load import load_scene
from cqrun.store.history import read_history
from cqrun.store.run import RunDirectory, read_record
from cqrun.store.trajectory import read_trajectory

PNEUMATIC = "muscle: {pneumatic: {body: finger, each: [left, right], axis: [0, 1], max_pressure: 4, law: chainqueen}}"
STRENGTH = "actuators.muscle.muscle.strength"


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Return a run that learned a controller and a strength; its goal is not drawn."""
    folder = tmp_path_factory.mktemp("trained")
    text = FINGER.replace(", spread: [0.05, 0.05]", "") + f"unknowns: {{{STRENGTH}: {{bounds: [2, 8]}}}}\n"
    return run_control(written(folder, text), [], folder / "out", threads=1)


def replay(source, out, *overrides, **options):
    return run_simulate(source, overrides, out, threads=1, **options)


def position(run):
    return read_trajectory(run / "trajectory.h5").fields["x"]


def test_it_is_the_run_to_the_bit(trained, tmp_path):
    run = replay(trained, tmp_path)
    np.testing.assert_array_equal(position(run), position(trained))
    assert (run / "activation.csv").read_bytes() == (trained / "activation.csv").read_bytes()
    assert (run / "controller.npz").read_bytes() == (trained / "controller.npz").read_bytes()
    result, learned = result_of(run), result_of(trained)
    assert result["terms"] == learned["trained"]["terms"]
    assert result["loss"] == learned["trained"]["loss"]
    assert result["goals"] == {"target": [0.6, 0.6]}
    assert (run.parent.name, read_record(run)["job"]) == ("finger", "simulate")
    assert "tip" in "\n".join(report_lines(run))
    np.testing.assert_array_equal(position(replay(run, tmp_path / "again")), position(run))  # of a replay, too


def test_longer_it_begins_the_same(trained, tmp_path):
    """The clock's period and the ranges are those of the training, not of the longer run."""
    run = replay(trained, tmp_path, "time.duration=0.15")
    x = position(run)
    assert len(x) == 16
    np.testing.assert_array_equal(x[:11], position(trained))


def test_another_goal_and_another_place(trained, tmp_path):
    away = replay(trained, tmp_path, "goals.target.position=[0.5, 0.7]")
    assert result_of(away)["goals"] == {"target": [0.5, 0.7]}
    assert result_of(away)["loss"] != result_of(trained)["loss"]
    there = replay(trained, tmp_path, "bodies.finger.place.offset=[0.25, 0.2]")
    here, moved = (position(run).mean(axis=1) for run in (trained, there))
    np.testing.assert_allclose(moved[0], here[0] + [0.05, 0.0], rtol=0, atol=1e-14)
    assert np.abs(moved[-1] - here[-1] - [0.05, 0.0]).max() > 1e-5  # it sees that it is elsewhere
    assert len({run.name for run in (away, there, trained)}) == 3


def test_a_goal_that_was_drawn_may_be_put_anywhere(tmp_path):
    """At the world's edge no spread would be left."""
    listener = Listener()
    run = replay(written(tmp_path), tmp_path, "goals.target.position=[0.98, 0.5]", reporter=listener)
    assert [line for line in listener.said if "warning" in line] == [f"warning: {UNTRAINED}"]
    assert result_of(run)["goals"] == {"target": [0.98, 0.5]}
    with pytest.raises(SceneError, match=r"goals.target.position: lies outside the world: x = 1.2 m"):
        replay(written(tmp_path), tmp_path, "goals.target.position=[1.2, 0.5]")


@pytest.mark.parametrize(
    ("term", "longer", "told"),
    [
        ("{track: {body: finger, marker: {file: wave.csv, marker: tip}}}", "0.2", "was seen from 0 to 0.1 s"),
        ("{track: {body: finger, keys: [[0.1, 0.5, 0.6]]}}", "0.05", "a key frame at 0.1 s is after the end"),
    ],
)
def test_terms_that_do_not_fit_another_time_are_left_out(tmp_path, term, longer, told):
    (tmp_path / "wave.csv").write_text("time,marker,x,y\n0,tip,0.5,0.6\n0.1,tip,0.5,0.7\n")
    scene = written(tmp_path)
    listener = Listener()
    run = replay(scene, tmp_path, f"objective.way={term}", f"time.duration={longer}", reporter=listener)
    assert [line.startswith("warning: ") and told in line for line in listener.said if "ignores it" in line] == [True]
    assert set(result_of(run)["terms"]) == {"tip", "effort"}
    fitting = replay(scene, tmp_path, f"objective.way={term}")
    assert set(result_of(fitting)["terms"]) == {"tip", "effort", "way"}
    (tmp_path / "wave.csv").unlink()
    without = result_of(replay(scene, tmp_path / "again", f"objective.way={term}"))
    assert ("way" in without["terms"]) is ("wave.csv" not in term)


def test_what_was_learned_beside_it_comes_with_it_unless_overridden(trained, tmp_path):
    learned = result_of(trained)["unknowns"][STRENGTH]["value"]
    assert f"strength: {learned}" in (replay(trained, tmp_path) / "scene.yaml").read_text()
    other = replay(trained, tmp_path, f"{STRENGTH}=5")
    assert "strength: 5" in (other / "scene.yaml").read_text()
    assert not np.array_equal(position(other), position(trained))


def test_numbers_for_every_particle_come_with_it(tmp_path):
    path = "bodies.finger.material.elastic.fixed_corotated.youngs_modulus"
    text = FINGER.replace(", spread: [0.05, 0.05]", "") + f"unknowns: {{{path}: {{bounds: [5, 20], per: particle}}}}\n"
    run = run_control(written(tmp_path, text), [], tmp_path / "out", threads=1)
    assert len(read_controller(run / "controller.npz")[1]["unknowns"][path]) == 48
    np.testing.assert_array_equal(position(replay(run, tmp_path)), position(run))
    with pytest.raises(UsageError, match=r"-o bodies.*: .* has a value of it for every group or particle"):
        replay(run, tmp_path, f"{path}=12")
    elastic = "bodies.finger.material.elastic"
    for part in (f"{elastic}={{neo_hookean: {{youngs_modulus: 19, poissons_ratio: 0.3}}}}", f"{elastic}={{unfit: 1}}"):
        with pytest.raises(UsageError, match=rf"holds {path}, which was learned; override other values only"):
            replay(run, tmp_path, part)
    with pytest.raises(UsageError, match="bodies and particles must be those it was trained with"):
        replay(run, tmp_path, "bodies.finger.sampling.lattice.count=3")


def test_a_change_counts_from_where_the_training_began(tmp_path):
    """The scene of a replay has the number that was learned; a file that does not say its start is taken as it is."""
    unknown = "unknowns: {bodies.finger.material.density: {bounds: [0.5, 2]}}\n"
    text = FINGER.replace(", spread: [0.05, 0.05]", "").replace("duration: 0.1", "duration: 0.05") + unknown
    same = "objective.same={unchanged: {body: finger, of: density, weight: 1.0e-3}}"
    run = run_control(written(tmp_path, text), [same], tmp_path / "out", threads=1)
    change = result_of(run)["trained"]["terms"]["same"]
    assert change > 1e-6
    assert result_of(replay(run, tmp_path))["terms"]["same"] == change
    parameters, meta = read_controller(run / "controller.npz")
    assert meta.pop("starts") == {"bodies.finger.material.density": 1.0}
    save_controller(run / "controller.npz", parameters, meta)
    assert result_of(replay(run, tmp_path / "older"))["terms"]["same"] == 0.0


def test_files_must_be_those_it_was_trained_with(trained, tmp_path):
    """A recorded motion stands for all that parts of a scene are read from; another file may be named in its place."""
    seen = tmp_path / "wave.csv"
    seen.write_text("time,marker,x,y\n0,tip,0.5,0.6\n0.1,tip,0.5,0.7\n")
    shutil.copy(seen, tmp_path / "same.csv")
    term = "{track: {body: finger, marker: {file: FILE, marker: tip}}}"
    recorded = "data={recordings: {swing: {file: same.csv, body: finger}}}"
    scene = load_scene(written(tmp_path), [f"objective.way={term.replace('FILE', 'wave.csv')}", recorded])
    with open_run("finger", scene, tmp_path / "out", job="control", threads=1, fresh=False) as begun:
        run = begun.path
    shutil.copy(trained / "controller.npz", run)
    (run / "result.json").write_text("{}")
    cqrun.load(run)
    seen.write_text(seen.read_text().replace("0.7", "0.8"))
    for act in (cqrun.load, designed, lambda run: replay(run, tmp_path / "replay")):
        with pytest.raises(UsageError, match=r"wave.csv has changed since the run began; run the scene again"):
            act(run)
    other = f"objective.way={term.replace('FILE', 'same.csv')}"
    cqrun.load(run, [other])
    (tmp_path / "same.csv").write_text(seen.read_text())
    with pytest.raises(UsageError, match=r"same.csv has changed since the run began"):
        cqrun.load(run, ["objective.way=null"])
    assert "way" not in scene_in(run, ["objective.way=null"]).objective  # which reads no recordings


def test_an_untrained_controller_acts_and_says_so(tmp_path):
    listener = Listener()
    run = replay(written(tmp_path), tmp_path / "out", reporter=listener)
    assert f"warning: {UNTRAINED}" in listener.said
    assert f"note: {UNTRAINED}" in report_lines(run)
    assert not (run / "controller.npz").exists()
    assert result_of(run)["goals"] == {"target": [0.6, 0.6]}  # in the middle of its range


def test_a_controller_of_another_scene_file(trained, tmp_path):
    scene = written(tmp_path)
    run = replay(scene, tmp_path / "out", controller=trained / "controller.npz")
    np.testing.assert_array_equal(position(run), position(trained))
    plain = replay(scene, tmp_path / "out")
    assert plain.name != run.name
    changed(scene, "muscle: {muscle: {body: finger, each: [left, right], axis: [0, 1], strength: 4}}", PNEUMATIC)
    with pytest.raises(UsageError, match=f"{STRENGTH} was learned .*; this scene has no such number"):
        replay(scene, tmp_path / "out", controller=trained / "controller.npz")


def test_elsewhere_it_acts_with_the_substeps_of_the_training(trained, tmp_path):
    """With `auto` the scene would have another number; a number that the scene gives stays, with a warning."""
    scene, controller = written(tmp_path, FINGER.replace(", substeps: 2", "")), trained / "controller.npz"
    assert result_of(trained)["substeps"] == 2
    kept = replay(scene, tmp_path / "out", controller=controller)
    np.testing.assert_array_equal(position(kept), position(trained))
    listener = Listener()
    for override in ("time.substeps=4", "time.substeps=auto"):
        other = replay(scene, tmp_path / "out", override, controller=controller, reporter=listener)
        assert load_scene(other / "scene.yaml").time.substeps != 2
    told = [line for line in listener.said if "was trained with" in line]
    assert told == [
        f"warning: {controller}: was trained with time.substeps=2, and this scene has 4: bodies may be a little softer "
        "or stiffer than in the training"
    ]
    parameters, meta = read_controller(controller)
    del meta["substeps"]
    save_controller(tmp_path / "older.npz", parameters, meta)
    older = replay(scene, tmp_path / "out", controller=tmp_path / "older.npz")
    assert load_scene(older / "scene.yaml").time.substeps != 2


def test_a_stopped_replay_runs_again_with_its_own_copy(trained, tmp_path):
    whole = replay(trained, tmp_path / "whole", "time.duration=0.2")
    source = tmp_path / "finger" / trained.name
    shutil.copytree(trained, source)
    with pytest.raises(Stopped, match=r"stopped at t = 0.02 s"):
        replay(source, tmp_path / "out", "time.duration=0.2", reporter=Listener(stop_after=3))
    shutil.rmtree(source)
    (run,) = (tmp_path / "out" / "finger").iterdir()
    assert_same(run_resume(run, [], threads=1), whole)
    (run / "controller.npz").unlink()
    (run / "run.json").write_text((run / "run.json").read_text().replace('"done"', '"stopped"'))
    with pytest.raises(UsageError, match="this copy of the controller is not what the run began with"):
        run_resume(run, [], threads=1)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("controller={mlp: {}}", "was trained with another controller: linear_tanh; this scene has mlp"),
        ("time.control_step=0.02", "was trained with another control step: 0.01; this scene has 0.02"),
        ("observers={parts: {centroids: {body: finger}}}", "another observer: parts, goal, clock; .* has parts"),
        ("actuators.muscle.muscle.each=[left]", "another actuator: muscle.left, muscle.right; .* has muscle.left"),
        ("observers.parts.centroids.of=[position]", "of another shape: weights 2 x 15, biases 2; .* has weights"),
    ],
)
def test_a_controller_that_is_not_this_scenes_is_refused(trained, tmp_path, override, message):
    with pytest.raises(UsageError, match=rf"controller.npz: .*{message}"):
        replay(trained, tmp_path, override)


def test_parameters_that_mean_something_else_are_told(trained, tmp_path):
    """Ranges and the spread of the start say nothing of what was learned; an older file does not tell."""
    gain, seen = "controller.linear_tanh.gain", "observers.parts.centroids.groups"
    neither = ("controller.linear_tanh.spread=0.5", "observers.clock.clock.range=[0, 1]")
    other = (f"{gain}=0.2", f"{seen}=[tip, left, right]", "actuators.muscle.muscle.rate=50", *neither)
    listener = Listener()
    run = replay(trained, tmp_path, *other, reporter=listener)
    (told,) = (line for line in listener.said if "acts differently" in line)
    assert told.startswith(f"warning: {trained}/controller.npz: acts differently than in its training: ")
    assert f"{gain} was 1.0, is 0.2; {seen} was all, is ['tip', 'left', 'right']; " in told
    assert told.endswith("actuators.muscle.muscle.rate was absent, is 50.0")
    assert told.removeprefix("warning: ") in result_of(run)["findings"]
    parameters, meta = read_controller(trained / "controller.npz")
    del meta["meaning"]
    save_controller(tmp_path / "older.npz", parameters, meta)
    assert Agent(build(load_scene(trained / "scene.yaml", other)), tmp_path / "older.npz").changes == []
    assert Agent(build(load_scene(trained / "scene.yaml", neither)), trained / "controller.npz").changes == []


def test_elsewhere_what_lies_at_a_place_in_the_world_acts_on_others(tmp_path):
    """A region does not move with the body; groups do (the tests above), and of other particles nothing is known."""
    region = "region: {box: {corner: [0.4, 0.2], size: [0.1, 0.4]}}"
    text = FINGER.replace("each: [left, right]", region).replace("max_iterations: 4", "max_iterations: 1")
    run = run_control(written(tmp_path, text), [], tmp_path / "out", threads=1)
    moved = "bodies.finger.place.offset=[0.25, 0.2]"
    with pytest.raises(UsageError, match="muscle would act on other particles than in the training"):
        replay(run, tmp_path / "moved", moved)
    too = "actuators.muscle.muscle.region={box: {corner: [0.45, 0.2], size: [0.1, 0.4]}}"
    replay(run, tmp_path / "both", moved, too)
    replay(run, tmp_path / "finer", "bodies.finger.sampling.lattice.count=5", "time.substeps=4")


def test_a_run_that_is_not_finished_has_its_best_controller(tmp_path):
    text = FINGER.replace(", spread: [0.05, 0.05]", "").replace("episodes: {count: 2, unseen: 1}\n", "")
    scene = written(tmp_path, text)
    with pytest.raises(Stopped):
        run_control(scene, [], tmp_path / "out", threads=1, reporter=Listener(stop_after=2))
    (run,) = (tmp_path / "out" / "finger").iterdir()
    found = result_of(replay(run, tmp_path / "early"))
    history = read_history(run / "history.csv")
    assert found["loss"] == pytest.approx(min(history["loss"]), rel=1e-12)
    with pytest.raises(UsageError, match="`cqrun simulate RUN` runs the best controller so far"):
        render(run, RenderOptions())
    (run / "controller.npz").unlink()
    with pytest.raises(UsageError, match=r"has no trained controller \(no iteration is finished\)"):
        replay(run, tmp_path / "none")


def test_a_resumed_run_keeps_what_was_better(trained):
    """Its history says how good the controller is that is kept."""
    best = min(read_history(trained / "history.csv")["loss"])
    saved = []
    problem = SimpleNamespace(
        built=build(load_scene(trained / "scene.yaml")), stochastic=False, values=lambda x: x,
        agent=SimpleNamespace(save=lambda path, x: saved.append((path.name, float(x[0])))),
        constraint_names=[], c_low=np.zeros(0), c_high=np.zeros(0), scales=np.zeros(0),
    )  # fmt: skip
    keep = Keeping(RunDirectory.resume(trained), problem, Silent())
    for k, loss in enumerate([best + 1.0, best, best - 1.0, best - 0.5]):
        keep(k, np.array([loss]), loss, {})
    assert saved == [("controller.npz", best - 1.0)]


def test_a_file_that_saw_other_numbers_or_says_nothing(trained, tmp_path):
    parameters, meta = read_controller(trained / "controller.npz")
    file = tmp_path / "other.npz"
    save_controller(file, parameters, meta | {"middle": meta["middle"][1:]})
    with pytest.raises(UsageError, match="it saw 14 numbers, and this scene's observers give 15"):
        replay(trained, tmp_path, controller=file)
    save_controller(file, parameters, {"controller": "linear_tanh"})
    with pytest.raises(UsageError, match="lacks the controller's actuators, control_step"):
        replay(trained, tmp_path, controller=file)


def test_a_run_without_a_controller(trained, tmp_path):
    scene = written(tmp_path)
    untrained = replay(scene, tmp_path / "out")
    assert replay(untrained, tmp_path / "out") == untrained  # its scene is run again
    record = json.loads((untrained / "run.json").read_text())
    (untrained / "run.json").write_text(json.dumps(record | {"job": "rest"}))
    with pytest.raises(UsageError, match=r"has no trained controller \(it is a run of rest\)"):
        replay(untrained, tmp_path / "out")
    with pytest.raises(UsageError, match=r"no run \(it has no run.json\)"):
        replay(tmp_path, tmp_path / "out")
    changed(scene, "controller: {linear_tanh: {}}\n", "")
    with pytest.raises(UsageError, match="a controller for a scene that has none"):
        replay(scene, tmp_path / "out", controller=trained / "controller.npz")
