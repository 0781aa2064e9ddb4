"""Errors of bad control scenes: exit code 2, the place of the mistake, what would be right; no run directory.

Images of one colour and meshes that are not closed are in tests/geometry/test_image.py and test_mesh.py.
"""

from __future__ import annotations

import numpy as np
import pytest
from small_beam import changed
from small_finger import FINGER, written

from cqrun.controllers.saved import save_controller

MUSCLE = "muscle: {muscle: {body: finger, each: [left, right], axis: [0, 1], strength: 4}}"
PARTS = "parts: {centroids: {body: finger, of: [position, velocity]}}"
TIP = "tip: {reach: {body: finger, group: tip, goal: target}}"
TARGET = "goals: {target: {position: [0.6, 0.6], spread: [0.05, 0.05]}}"
ADAM = "optimizer: {adam: {learning_rate: 0.1, max_iterations: 4}}"


def cable(route: str) -> str:
    return f"string: {{cable: {{body: finger, route: {route}, stiffness: 10}}}}"


CASES = {
    # --- actuators
    "an actuator over no particles": (
        "each: [left, right]",
        "region: {ball: {center: [0.9, 0.9], radius: 0.01}}",
        ["actuators.muscle.muscle.region: holds no particle: 'finger' lies within (0.4125, 0.25) to (0.5875, 0.775) m"],
    ),
    "each, naming no group": (
        "each: [left, right]",
        "each: [left, rihgt]",
        [
            "finger.yaml:19:48: actuators.muscle.muscle.each.1: there is no group of the body 'finger' 'rihgt' "
            "(did you mean 'right'?); there are: left, right, tip"
        ],
    ),
    "an actuator of groups and of a region": (
        "each: [left, right]",
        "each: [left, right], region: {half_space: {point: [0.5, 0.3], normal: [0, 1]}}",
        ["actuators.muscle.muscle.region: cannot be combined with `each`: give one of the two, or name a reg"],
    ),
    "a colour of a body without an image": (
        "each: [left, right]",
        "region: {colour: red}",
        ["actuators.muscle.muscle.region: the body 'finger' is not made from an image, so its particles have no"],
    ),
    "a push that throws particles out of their cells": (
        f"{MUSCLE}|substeps: 2",
        "push: {body_force: {body: finger, direction: [0, 1], acceleration: 1.0e6}}|substeps: 2",
        ["time.substeps: a substep of 0.005 s is", "0.000316 s (actuators.push.body_force)"],
    ),
    "an actuator of no body": (
        "{muscle: {body: finger",
        "{muscle: {body: fingre",
        ["actuators.muscle.muscle.body: there is no body 'fingre' (did you mean 'finger'?); there are: finger"],
    ),
    "a cable through one particle": (
        MUSCLE,
        cable("[[0.41, 0.25], [0.41, 0.251]]"),
        ["finger.yaml:19:12: actuators.string.cable: runs through fewer than two particles: lengthen the route"],
    ),
    "a cable through a particle twice": (
        MUSCLE,
        cable("[[0.41, 0.25], [0.41, 0.55], [0.41, 0.25]]"),
        ["actuators.string.cable: runs through a particle twice: separate the points of the route, or tie it less"],
    ),
    "a cable beside its body": (
        MUSCLE,
        cable("[[0.41, 0.25], [0.9, 0.55]]"),
        ["actuators.string.cable: its point (0.9, 0.55) is 0.3", "within a cell (0.1 m) of a particle"],
    ),
    "a group named twice": (
        "each: [left, right]",
        "each: [left, left]",
        ["finger.yaml:19:48: actuators.muscle.muscle.each.1: 'left' is named twice: a group has one activation"],
    ),
    "a cable with neighbours at one particle": (
        MUSCLE,
        cable("[[0.41, 0.25], [0.41, 0.251], [0.41, 0.55]]"),
        ["actuators.string.cable: runs through a particle twice: separate the points of the route, or tie it less"],
    ),
    "a cable with coincident neighbours": (
        MUSCLE,
        cable("[[0.41, 0.25], [0.41, 0.25], [0.41, 0.55]]"),
        ["actuators.string.cable.route.1: is the same as the point before it: remove one of the two"],
    ),
    "a cable along one point": (
        MUSCLE,
        cable("[[0.41, 0.25]]"),
        ["actuators.string.cable.route: must have at least 2 entries, has 1"],
    ),
    # --- who drives them
    "a controller and signals": (
        "controller:",
        "activation: {signals: {muscle: [0, 1]}}\ncontroller:",
        ["finger.yaml:24:1: activation: the controller 'linear_tanh' already drives the actuators: remove one of the"],
    ),
    "a controller without actuators": (
        f"actuators:\n  {MUSCLE}\n",
        "",
        ["finger.yaml:22:1: controller: has no actuator to drive: add one to `actuators`"],
    ),
    "signals beyond an actuator's limits": (
        "controller: {linear_tanh: {}}",
        "activation: {signals: {muscle: [0, 1.5]}}",
        ["activation.signals.muscle.1: must be between -1 and 1, the limits of the muscle 'muscle', is 1.5"],
    ),
    "random signals beyond them": (
        "controller: {linear_tanh: {}}",
        "activation: {random: {sequences: 1, knots: 2, low: -2}}",
        ["activation.random.low: must be between -1 and 1, the limits of the muscle 'muscle', is -2"],
    ),
    # --- what is seen
    "an observer of no body": (
        PARTS,
        PARTS.replace("finger", "thumb"),
        ["finger.yaml:21:29: observers.parts.centroids.body: there is no body 'thumb'; there are: finger"],
    ),
    "an observer of no group": (
        "of: [position, velocity]",
        "groups: [left, tips]",
        [
            "finger.yaml:21:52: observers.parts.centroids.groups.1: there is no group of the body 'finger' 'tips' "
            "(did you mean 'tip'?); there are: left, right, tip"
        ],
    ),
    "an observer of no goal": (
        "{goal: {goal: target}}",
        "{goal: {goal: traget}}",
        [
            "finger.yaml:22:23: observers.goal.goal.goal: there is no goal 'traget' (did you mean 'target'?); "
            "there are: target"
        ],
    ),
    "more clusters than particles": (
        PARTS,
        "parts: {clusters: {body: finger, count: 49}}",
        ["finger.yaml:21:3: observers.parts: 49 clusters of 48 particles: there can be at most one per particle"],
    ),
    "a cluster's region of more than there are": (
        "each: [left, right]",
        "region: {cluster: {count: 49, index: 0}}",
        ["actuators.muscle.muscle.region: 49 clusters of 48 particles: there can be at most one per particle"],
    ),
    "a range for other entries": (
        "{goal: {goal: target}}",
        "{goal: {goal: target, range: [[0, 1], [0, 1], [0, 1]]}}",
        ["finger.yaml:22:3: observers.goal: a range has 3 pairs [low, high] for 2 entries; give 2 or one"],
    ),
    "one range for all quantities": (
        PARTS,
        PARTS.replace("of: [position, velocity]", "range: [0, 1]"),
        ["observers.parts.centroids.range: must have a range for each quantity, such as {position: [0, 1], velocity: "],
    ),
    "a group that is no list": (
        PARTS,
        PARTS.replace("of: [position, velocity]", "groups: tip"),
        ["observers.parts.centroids.groups: must be a list, or 'all', is 'tip'"],
    ),
    "an axis of words": (
        MUSCLE,
        MUSCLE.replace("axis: [0, 1]", "axis: [up, 1]"),
        ["actuators.muscle.muscle.axis.0: must be a number, is 'up'"],
    ),
    "an axis that is no word for one": (
        MUSCLE,
        MUSCLE.replace("axis: [0, 1]", "axis: isotropc"),
        ["actuators.muscle.muscle.axis: must be a list, or 'isotropic', is 'isotropc' (did you mean 'isotropic'?)"],
    ),
    # --- what it is for
    "an objective of no body": (
        TIP,
        TIP.replace("finger", "thumb"),
        ["objective.tip.reach.body: there is no body 'thumb'; there are: finger"],
    ),
    "an objective of no group": (
        TIP,
        TIP.replace("group: tip", "group: top"),
        [
            "objective.tip.reach.group: there is no group of the body 'finger' 'top' (did you mean 'tip'?); "
            "there are: left, right, tip"
        ],
    ),
    "an objective of no goal": (
        TIP,
        TIP.replace("goal: target", "goal: aim"),
        ["objective.tip.reach.goal: there is no goal 'aim'; there are: target"],
    ),
    "an objective at no body": (
        TIP,
        TIP.replace("goal: target", "target: ball"),
        ["objective.tip.reach.target: there is no body 'ball'; there are: finger"],
    ),
    "an objective of a goal that is no position": (
        TARGET,
        TARGET.replace("[0.6, 0.6]", "[0.6]").replace("[0.05, 0.05]", "[0.05]"),
        ["observers.goal: the goal 'target' has 1 entries; a position here has 2"],
    ),
    "a goal outside the world": (
        TARGET,
        TARGET.replace("position: [0.6, 0.6]", "position: [0.6, 1.2]"),
        ["goals.target.position: lies outside the world: y = 1.15 to 1.25 m; it holds 0 to 1 m, move it inside"],
    ),
    "a goal that may be drawn outside": (
        TARGET,
        TARGET.replace("spread: [0.05, 0.05]", "spread: [0.5, 0]"),
        ["finger.yaml:25:18: goals.target.position: lies outside the world: x = 0.1 to 1.1 m; it holds 0 to 1 m"],
    ),
    "a goal that nothing asks for": (
        TARGET,
        TARGET.replace("target: {", "taget: {position: [0.5, 0.6]}, target: {"),
        ["goals.taget: no part of the scene uses it; goals that are used: target"],
    ),
    "a place outside the world": (
        TIP,
        TIP.replace("goal: target", "position: [0.5, 5]"),
        ["objective.tip.reach.position: lies outside the world: y = 5 m; it holds 0 to 1 m, move it inside"],
    ),
    "a path that leaves the world": (
        TIP,
        "tip: {track: {body: finger, group: tip, path: [[0, 0.5, 0.7], [0.1, -0.2, 0.7]]}}",
        ["objective.tip.track.path.1: lies outside the world: x = -0.2 m; it holds 0 to 1 m, move it inside"],
    ),
    # --- what is missing
    "no controller": ("controller: {linear_tanh: {}}\n", "", ["controller: control needs it: say what drives the act"]),
    "no objective": (
        f"objective:\n  {TIP}\n  effort: {{effort: {{weight: 1.0e-3}}}}\n",
        "",
        ["objective: control needs it: say what the motion is for, such as `far: {distance: "],
    ),
    "a controller of nothing that it sees": (
        f"observers:\n  {PARTS}\n  goal: {{goal: {{goal: target}}}}\n  clock: {{clock: {{}}}}\n",
        "",
        ["finger.yaml:20:1: controller: the controller linear_tanh acts on observations and there are none: add an"],
    ),
    # --- how it is learned
    "fresh goals for lbfgs": (
        f"episodes: {{count: 2, unseen: 1}}|{ADAM}",
        "episodes: {count: 2, fresh: true}|optimizer: {lbfgs: {}}",
        [
            "finger.yaml:31:13: optimizer.lbfgs: the objective draws fresh goals at every iteration, and optimizer "
            "lbfgs needs the same loss twice at the same point: use adam or sgd, or fix the set of goals"
        ],
    ),
    "mini-batches larger than the set": (
        ADAM,
        ADAM.replace("max_iterations: 4", "batch_size: 3"),
        ["optimizer.adam: batch_size is 3, but the data falls into 2 parts (recordings, goals): give"],
    ),
    "mini-batches of fresh goals": (
        f"episodes: {{count: 2, unseen: 1}}|{ADAM}",
        "episodes: {count: 2, fresh: true}|" + ADAM.replace("max_iterations: 4", "batch_size: 1"),
        ["optimizer.adam: batch_size takes parts of a fixed set, but the objective draws fresh goals at every iter"],
    ),
    "least squares": (
        ADAM,
        "optimizer: {least_squares: {}}",
        ["optimizer.least_squares: fits data by least squares; for an objective take adam, sgd, lbfgs or cma_es"],
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_the_error_says_where_and_what_and_no_run_remains(cqrun, tmp_path, case):
    old, new, messages = CASES[case]
    scene = written(tmp_path)
    for a, b in zip(old.split("|"), new.split("|"), strict=True):
        changed(scene, a, b)
    answers = [cqrun(*words) for words in (("control", scene, "--out", tmp_path / "out"), ("validate", scene))]
    (code, out, err), (code_too, _, err_too) = answers
    assert (code, code_too) == (2, 2), err
    assert out == ""
    for message in messages:
        assert message in err, err
        assert message in err_too, err_too
    assert str(scene) in err
    assert not (tmp_path / "out").exists()


def test_the_error_names_the_override_that_caused_it(cqrun, tmp_path):
    scene = written(tmp_path)
    for override in ("goals.target.position=[0.6, 2]", "goals.target.spread=[0, 0.5]"):
        code, _, err = cqrun("control", scene, "-o", override, "--out", tmp_path / "out")
        assert code == 2
        assert err.startswith(f"-o {override}: goals.target.position: lies outside the world")


def test_zero_seeds_are_refused(cqrun, tmp_path):
    scene = written(tmp_path)
    code, _, err = cqrun("control", scene, "--seeds", "0", "--out", tmp_path / "out")
    words = "must be at least 1; without it the scene is learned from its own seed"
    assert (code, err) == (2, f"error: --seeds 0: {words}\n")
    code, _, err = cqrun("codesign", scene, "--ablate", "--seeds", "0", "--out", tmp_path / "out")
    assert (code, err) == (2, f"error: --seeds 0: {words}\n")
    code, _, err = cqrun("control", scene, "--jobs", "2", "--out", tmp_path / "out")
    assert (code, err) == (2, "error: --jobs 2: is the number of seeds that run at once: add --seeds N\n")
    code, _, err = cqrun("control", "finger.yaml", "--on", "dask")
    assert (code, err) == (2, "error: --on dask: is the place where several seeds run: add --seeds N\n")
    assert not (tmp_path / "out").exists()


def test_a_controller_file_of_another_shape(cqrun, tmp_path):
    scene = written(tmp_path)
    facts = {"controller": "linear_tanh", "actuators": ["muscle.left", "muscle.right"], "control_step": 0.01}
    facts |= {"observers": ["parts", "goal", "clock"], "middle": [0.0] * 9, "half": [1.0] * 9, "n_controls": 10}
    file = tmp_path / "controller.npz"
    save_controller(file, {"weights": np.zeros((2, 9)), "biases": np.zeros(2)}, facts | {"unknowns": {}})
    code, _, err = cqrun("simulate", scene, "--controller", file, "--out", tmp_path / "out")
    assert code == 2
    error = err.splitlines()[-1]
    assert error.startswith(
        f"error: {file}: holds a controller of another shape: weights 2 x 9, biases 2; this scene's "
    )
    for content, words in ((None, "cannot be read as a controller file"), (b"else", "is not a controller file")):
        other = tmp_path / "other.npz"
        if content is not None:
            other.write_bytes(content)
        code, _, err = cqrun("simulate", scene, "--controller", other, "--out", tmp_path / "out")
        assert code == 2
        assert words in err
    assert not (tmp_path / "out").exists()


def test_the_unchanged_small_finger_is_valid(cqrun, tmp_path):
    code, out, err = cqrun("validate", written(tmp_path, FINGER))
    assert (code, err) == (0, "")
    assert "controller linear_tanh: 32 parameters (weights 2 x 15, biases 2)\n" in out
    assert "from 15 numbers to 2 activations within -1 to 1, every 0.01 s\n" in out
    assert "observer   parts (centroids): 12 numbers\n" in out
    assert "goal       target: (0.6, 0.6) m, drawn within (0.05, 0.05) m to either side\n" in out
    assert "episodes   a fixed set of 2; the result is tested on 1 more\n" in out
    assert "objective  tip (reach): final, weight 1, smaller is better\n" in out
    assert "an iteration of adam: 2 episodes with the gradient, " in out
