"""`cqrun codesign`: constraints and their gradients, what a run finds, and what it says where nothing will do."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from small_beam import Listener, result_of
from small_finger import DESIGN, STIFFNESS, written

from cqrun.build.model import build
from cqrun.cli.results import infeasible_shown
from cqrun.design.spread import mirrored
from cqrun.errors import InfeasibleError, RunError, SceneError, UsageError
from cqrun.jobs.control import CODESIGN, CONTROL, run_codesign, run_control
from cqrun.jobs.gradcheck import run_gradcheck
from cqrun.jobs.resume import run_resume
from cqrun.jobs.simulate import run_simulate
from cqrun.jobs.table import report_lines
from cqrun.jobs.validate import validate
from cqrun.running.reporter import Silent
from cqrun.scene.load import load_scene
from cqrun.scene.references import TAKEN
from cqrun.store.history import read_history
from cqrun.store.run import read_record

FINGER = Path(__file__).parents[2] / "scenes" / "robots" / "finger_codesign.yaml"
MORE = [
    "unknowns.bodies.finger.material.density={bounds: [0.5, 2], per: group}",
    "constraints.heavy={of: {mass: {body: finger, group: tip}}, equals: 20}",
    "constraints.room={of: {volume: {body: finger}}, at_most: 1}",
    "constraints.stiff={of: {stiffness: {body: finger}}, at_most: 12}",
]


@pytest.fixture
def finger(tmp_path):
    """Return the scene of the small finger with a design to find."""
    return written(tmp_path, DESIGN)


@pytest.fixture(scope="module")
def problem():
    """Return its problem, with constraints on the motion and on the design."""
    return CODESIGN.prepare(load_scene(DESIGN, MORE), 1, Silent())


@pytest.fixture
def somewhere(problem, rng):
    """Return a point and a direction inside the bounds."""
    x = problem.start + 0.1 * rng.standard_normal(problem.start.shape)
    return np.clip(x, problem.lower + 0.05, problem.upper - 0.05), rng.standard_normal(x.shape)


def learn(scene, out, *overrides, job=CODESIGN):
    return job.run(scene, overrides, out, threads=1)


# --- gradients ----------------------------------------------------------------------------------------------------


def test_constraints_are_in_their_scale(problem):
    assert problem.constraint_names == ["tip", "up", "heavy", "room", "stiff"]
    np.testing.assert_allclose(problem.c_low, [-np.inf, 0.3, 20, -np.inf, -np.inf])
    np.testing.assert_allclose(problem.c_high, [1.8, 0.9, 20, 1, 12])
    _, c = problem.values_and_constraints(problem.start)
    episodes = [problem.attempt(problem.values(problem.start), goals, 1) for goals in problem.goals(None)]
    np.testing.assert_allclose(c[0], 100 * np.mean([a.constraints["tip"] for a in episodes]), rtol=1e-14)


def test_the_jacobian_is_that_of_the_values(problem, somewhere):
    x, way = somewhere
    f, g, c, J = problem.gradients_and_constraints(x)
    assert (f, *c) == (problem.values_and_constraints(x)[0], *problem.values_and_constraints(x)[1])
    h = 1e-3
    steps = [problem.values_and_constraints(x + k * h * way) for k in (-2, -1, 1, 2)]
    values = np.array([np.concatenate([[f], c]) for f, c in steps])
    slope = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * h)  # fourth order
    np.testing.assert_allclose(np.concatenate([[g @ way], J @ way]), slope, rtol=1e-7, atol=1e-12)
    assert np.all(np.abs(J[[2, 4]] @ way) > 1e-3)
    assert not J[3].any(), "nothing here changes the volume at rest"


def test_one_sweep_gives_the_lagrangians_gradient(problem, somewhere):
    x, _ = somewhere
    f, g, c, J = problem.gradients_and_constraints(x)
    weights = np.array([0.3, -2.0, 0.1, 0.5, 0.2])
    found_f, found_c, gradient = problem.lagrangian(x, lambda c: weights * c)
    assert found_f == f
    np.testing.assert_array_equal(found_c, c)
    np.testing.assert_allclose(gradient, g + (weights * c) @ J, rtol=1e-10, atol=1e-13)


# --- runs ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "method",
    ["slsqp: {max_iterations: 30}", "sqp: {max_iterations: 30}", "augmented_lagrangian: {max_iterations: 60}"],
)
def test_it_meets_its_constraints(finger, tmp_path, method):
    run = learn(finger, tmp_path, f"optimizer={{{method}}}")
    result = result_of(run)
    assert (result["job"], read_record(run)["job"]) == ("codesign", "codesign")
    tip = result["constraints"]["tip"]
    assert tip["start"] > 0.024
    assert tip["value"] <= 0.018 + 1e-6 * 0.01
    assert tip["violation"] <= 1e-8
    assert result["constraints"]["up"].keys() == {"at_least", "at_most", "start", "value", "violation"}
    assert len(result["unknowns"][STIFFNESS]["value"]) == 48
    assert np.ptp(result["unknowns"][STIFFNESS]["value"]) > 1e-3
    rows = read_history(run / "history.csv")
    assert min(rows["violation"]) <= 1e-6
    text = "\n".join(report_lines(run))
    assert re.search(r"constraint +wanted +before +learned +violated by", text)
    assert "at least 0.3, at most 0.9" in text
    assert f"{STIFFNESS}  10" in text
    assert min(rows["growth_at"]) >= 0.0, "the effort does not hang on the motion, the constraints do"


def test_a_replay_tells_what_becomes_of_the_constraints(finger, tmp_path):
    learned = learn(finger, tmp_path, "optimizer={sqp: {max_iterations: 3}}", "goals.target.spread=null")
    same, longer = (
        run_simulate(learned, more, tmp_path / "replay", threads=1) for more in ([], ["time.duration=0.12"])
    )
    tip = result_of(learned)["constraints"]["tip"]
    del tip["start"]
    assert result_of(same)["constraints"]["tip"] == tip
    assert result_of(longer)["constraints"]["tip"]["value"] != tip["value"]
    assert re.search(r"constraint +wanted +value +violated by\ntip +at most 0.018", "\n".join(report_lines(longer)))


def test_constraints_alone_are_something_to_learn(finger, tmp_path):
    listener = Listener()
    run = run_codesign(finger, ["objective=null"], tmp_path, threads=1, reporter=listener)
    assert result_of(run)["constraints"]["tip"]["violation"] <= 1e-8
    assert not [line for line in listener.said if "nothing was learned" in line]


def test_to_control_a_scene_with_a_design_says_that_it_learns_both(finger, tmp_path):
    listener = Listener()
    fewer = "optimizer={sqp: {max_iterations: 1}}"
    with pytest.raises(RunError):
        run_control(finger, [fewer], tmp_path, threads=1, reporter=listener)
    assert [line for line in listener.said if f"unknowns: {STIFFNESS} learned together with the controller" in line]


@pytest.mark.usefixtures("pictures")
def test_a_design_that_cannot_be_had_ends_infeasible_and_is_kept(finger, tmp_path, capsys):
    told = (
        r"constraint 'tip' is 0\.01\d+, wanted at most 0\.001: violated by 0\.01\d+ \(1\.\d+ of its scale\), the least "
        r"that was found; (\w+ is violated less; )?(no unknown is at a bound|at their bounds: .*)"
    )
    with pytest.raises(RunError, match=told):
        learn(finger, tmp_path, "constraints.tip.at_most=0.001", "optimizer.slsqp.max_iterations=15")
    (folder,) = (tmp_path / "finger").iterdir()
    result = result_of(folder)
    assert result["status"] == read_record(folder)["status"] == "infeasible"
    assert result["constraints"]["tip"]["value"] < result["constraints"]["tip"]["start"]
    assert (folder / "controller.npz").is_file()
    with (
        pytest.raises(InfeasibleError),
        infeasible_shown(quiet=True, allow_plugins=False),
    ):  # as the command line runs it
        learn(finger, tmp_path, "constraints.tip.at_most=0.001", "optimizer.slsqp.max_iterations=15")
    told = r"infeasible after \d+ iterations: not met[^:]* may help: constraint 'tip'"
    assert re.search(told, capsys.readouterr().out)
    assert (folder / "figures" / "convergence.png").is_file()


def test_an_extended_design_is_that_of_a_longer_run(finger, tmp_path):
    limited = "optimizer.slsqp.max_iterations={}"
    run = learn(finger, tmp_path / "short", limited.format(6))
    assert run_resume(run, [limited.format(9)], threads=1) == run
    longer = learn(finger, tmp_path / "long", limited.format(9))
    mine, other = (read_history(folder / "history.csv") for folder in (run, longer))
    assert len(mine["loss"]) == 10
    assert all(mine[name] == other[name] for name in mine if name != "seconds")
    assert result_of(run)["unknowns"] == result_of(longer)["unknowns"]


def test_a_mirrored_field_is_smooth_and_the_same_on_either_side(finger, tmp_path):
    run = learn(finger, tmp_path, f"unknowns.{STIFFNESS}={{bounds: [5, 20], per: field, resolution: 3, mirror: x}}")
    result = result_of(run)
    assert result["constraints"]["tip"]["violation"] <= 1e-8
    values = np.array(result["unknowns"][STIFFNESS]["value"])
    x = build(load_scene(finger)).particles.x
    _, twin = cKDTree(x).query(mirrored(x, 0))
    assert len(values) == 48
    assert np.ptp(values) > 1e-6
    np.testing.assert_allclose(values, values[twin], rtol=1e-9)


def test_a_regulariser_holds_a_design_near_its_start(finger, tmp_path):
    strength = "actuators.muscle.muscle.strength"
    only = ["unknowns={}", "constraints={}", "objective={tip: {reach: {body: finger, group: tip, goal: target}}}"]
    ways = {}
    for weight in (0.0, 10.0):
        bounded = f"unknowns.{strength}={{bounds: [1, 8], initial: 4, regulariser: {weight}}}"
        run = learn(finger, tmp_path, *only, "optimizer={adam: {max_iterations: 8}}", bounded)
        result = result_of(run)
        ways[weight] = abs(result["unknowns"][strength]["value"] - 4.0)
    rows = read_history(run / "history.csv")
    np.testing.assert_allclose(rows["loss"], np.add(rows["tip"], rows["regulariser"]), rtol=1e-12)
    assert rows["regulariser"][0] == 0.0 < rows["regulariser"][1]
    assert result["trained"]["terms"].keys() == {"tip", "regulariser"}
    replay = result_of(run_simulate(run, [], tmp_path / "replay", threads=1))
    assert replay["terms"]["regulariser"] == pytest.approx(result["trained"]["terms"]["regulariser"], rel=1e-12)
    assert replay["loss"] == pytest.approx(sum(replay["terms"].values()), rel=1e-12)
    assert 0.0 < ways[10.0] < 0.5 * ways[0.0]


@pytest.mark.parametrize("name", [*TAKEN])
def test_no_term_is_called_as_a_column_of_the_history_is(finger, name):
    with pytest.raises(SceneError, match=rf"objective.{name}: history.csv already has a column of this name"):
        load_scene(finger, [f"objective.{name}={{effort: {{}}}}"])


def test_the_names_of_the_historys_columns_are_known(finger, tmp_path):
    density = "unknowns.bodies.finger.material.density={bounds: [0.5, 2], regulariser: 1}"
    run = learn(finger, tmp_path, density, "optimizer.slsqp.max_iterations=2")
    columns = read_history(run / "history.csv").keys()
    assert {name for name in columns if name.isidentifier()} == {*TAKEN, "effort"}


def test_groups_are_the_same_on_either_side(finger, tmp_path):
    both = f"unknowns.{STIFFNESS}={{bounds: [5, 20], per: group, mirror: x}}"
    result = result_of(learn(finger, tmp_path, both, "optimizer={adam: {max_iterations: 2}}", "constraints={}"))
    left, right, tip = result["unknowns"][STIFFNESS]["value"]
    assert left == right != tip
    with pytest.raises(SceneError, match=r"particles of 'finger' have no mirror image across y"):
        learn(finger, tmp_path, both.replace("mirror: x", "mirror: y"))


def test_a_result_tells_what_is_at_its_bounds(finger, tmp_path):
    narrow = f"unknowns.{STIFFNESS}={{bounds: [9.99, 10.01], per: particle, initial: 9.99}}"
    near = "objective.tip={reach: {body: finger, group: tip, goal: target}}"
    adam = "optimizer={adam: {learning_rate: 0.1, max_iterations: 8}}"
    run = learn(finger, tmp_path, narrow, near, adam, "constraints={}")
    (entry,) = result_of(run)["unknowns"].values()
    ends = entry["at_bounds"]
    assert ends == {"lower": entry["value"].count(9.99), "upper": entry["value"].count(10.01)}
    assert ends["lower"] + ends["upper"] >= 2  # no gradient reaches the lowest, which are held
    assert any(re.search(r"(lower|upper) of 48$", line) for line in report_lines(run))


def test_what_unknowns_do_not_reach_or_replace_is_told(finger):
    parts = [
        "bodies.finger.groups.half={box: {corner: [1, 0], size: [0.5, 3]}}",
        f"unknowns.{STIFFNESS}={{bounds: [5, 20], per: group}}",
        "unknowns.bodies.finger.material.density={bounds: [0.5, 2], "
        "also: {actuators.muscle.muscle.strength: {factor: 3}}}",
    ]
    told = [str(warning) for warning in build(load_scene(finger, parts)).warnings]
    assert any(
        "24 particles of 'finger' are in several groups, and have the value of the last" in line for line in told
    )
    assert any(
        "actuators.muscle.muscle.strength starts at 3, because of `also`, and not at its value 4" in line
        for line in told
    )
    loose = ["bodies.finger.parts=null", "bodies.finger.shape={box: {corner: [1, 0], size: [1, 3]}}",
             "bodies.finger.sampling={lattice: {count: 12}}",
             "bodies.finger.groups={tip: {box: {corner: [1, 2], size: [1, 1]}}}", "actuators.muscle.muscle.each=null",
             *parts[1:2]]  # fmt: skip
    told = [str(warning) for warning in build(load_scene(finger, loose)).warnings]
    assert any(
        "96 of 144 particles of 'finger' are in no group: their values do not change" in line for line in told
    ), told


def test_constraints_alone_are_enough(finger, tmp_path):
    run = learn(finger, tmp_path, "objective={}")
    assert result_of(run)["constraints"]["tip"]["violation"] <= 1e-8


def test_neither_objective_nor_constraints_may_look_at_the_motion(finger, tmp_path):
    stiff = "constraints={stiff: {of: {stiffness: {body: finger}}, at_most: 9}}"
    run = learn(finger, tmp_path, "objective={effort: {effort: {}}}", stiff)
    assert result_of(run)["constraints"]["stiff"]["value"] <= 9 + 1e-6


def test_control_honours_constraints_too(finger, tmp_path):
    run = learn(finger, tmp_path, f"unknowns.{STIFFNESS}=null", job=CONTROL)
    assert result_of(run)["job"] == "control"
    assert result_of(run)["constraints"]["tip"]["violation"] <= 1e-8


def test_a_body_alone_is_designed_if_its_activations_are_given(finger, tmp_path):
    """The stiffness that brings the tip nearest to its goal with one muscle, and the replay of what was found."""
    given = ["controller={given: {knots: [[1, 0]]}}", "constraints={}", "optimizer={adam: {max_iterations: 3}}"]
    goal = ["objective={tip: {reach: {body: finger, group: tip, goal: target}}}", "goals.target.spread=null"]
    run = learn(finger, tmp_path, *given, *goal, "episodes.unseen=0")
    result = result_of(run)
    assert set(result["unknowns"]) == {STIFFNESS}
    assert result["loss"] < read_history(run / "history.csv")["loss"][0]
    replay = result_of(run_simulate(run, [], tmp_path / "replay", threads=1))
    assert replay["loss"] == result["loss"]


@pytest.mark.slow
def test_a_finger_at_rest_is_designed_alone(tmp_path):
    """Thinner walls and stiffer fibres bend it at less pressure, until the walls stretch too far."""
    coarse = ["world.dx=0.002", "bodies.finger.spacing=0.001", "constraints.stretch.at_most=1.15"]
    run = learn(FINGER, tmp_path, *coarse)
    result = result_of(run)
    assert result["status"] == "converged"
    assert result["loss"] < 0.5 * read_history(run / "history.csv")["loss"][0]
    assert result["constraints"]["bent"]["value"] == pytest.approx(-0.5, abs=1e-5)
    assert result["constraints"]["stretch"]["value"] <= 1.15 + 1e-6
    replay = run_simulate(run, [], tmp_path / "replay", threads=1)
    assert result_of(replay)["loss"] == result["loss"]
    before = run_simulate(FINGER, coarse, tmp_path / "before", threads=1)
    assert result_of(before)["findings"] == []  # what is given need not be learned


def test_the_gradient_of_a_design_at_rest_agrees_with_differences(tmp_path):
    coarse = ["world.dx=0.002", "bodies.finger.spacing=0.001"]
    run, agrees = run_gradcheck(FINGER, coarse, tmp_path, threads=1)
    assert agrees, "\n".join(report_lines(run))


def test_validate_tells_the_constraints(finger):
    text = "\n".join(validate(finger))
    assert "constraint tip (reach): at most 0.018, with a tolerance of 1e-08" in text
    assert "constraint up (height): at least 0.3, at most 0.9, with a tolerance of 1e-06" in text
    assert re.search(r"a trial of slsqp: .* and the gradients of 2 constraints, at most", text)
    other = "\n".join(validate(finger, ["optimizer={trust_constr: {}}"]))
    assert re.search(r"a trial of trust_constr: .* and the gradients of 2 constraints, at most", other)


def test_a_run_whose_scene_was_edited_is_not_continued(finger, tmp_path):
    """Its log has answers for the body that it began with."""
    overrides = ["constraints={}", "optimizer={adam: {max_iterations: 1}}"]
    run = learn(finger, tmp_path, *overrides)
    file, told = run / "scene.yaml", "scene.yaml: has changed since the run began"
    for limit in (2, 3):  # one that was extended is known by another mark
        text = file.read_text()
        file.write_text(text.replace("density: 1", "density: 2"))
        assert file.read_text() != text
        with pytest.raises(UsageError, match=told):
            run_resume(run, [f"optimizer.adam.max_iterations={limit}"], threads=1)
        file.write_text(text)
        run_resume(run, [f"optimizer.adam.max_iterations={limit}"], threads=1)
    assert result_of(run)["iterations"] == 3


# --- refusals -------------------------------------------------------------------------------------------------------


def test_what_follows_has_no_values_of_its_own_in_parts(finger):
    elastic = "elastic: {fixed_corotated: {youngs_modulus: 10, poissons_ratio: 0.3}}"
    other = (
        "bodies.other={shape: {box: {corner: [0.7, 0.2], size: [0.1, 0.1]}}, spacing: 0.05, "
        "groups: {tip: {box: {corner: [0.7, 0.25], size: [0.1, 0.05]}}}, material: {density: 1, " + elastic + "}, "
        "material_of: {tip: {elastic: {fixed_corotated: {youngs_modulus: 99, poissons_ratio: 0.3}}}}}"
    )
    follower = STIFFNESS.replace("finger", "other")
    unknown = f"unknowns.{STIFFNESS}={{bounds: [5, 20], per: particle, also: [{follower}]}}"
    told = rf"also.{follower}: material_of sets a separate value for tip: remove it"
    with pytest.raises(SceneError, match=told):
        load_scene(finger, [other, unknown])
    load_scene(finger, [other, "bodies.other.material_of={}", unknown])


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("optimizer={adam: {}}", "optimizer.adam: does not support constraints; take augmented_lagrangian, nlopt, "),
        (f"unknowns.{STIFFNESS}=null", "unknowns: codesign needs it: say what of the design may change"),
        ("constraints.up.equals=0.5", "constraints.up: needs `at_least`, `at_most` or both, or else `equals`"),
        ("constraints.up.at_least=0.95", "constraints.up.at_most: no value is allowed: at_least 0.95 is not below"),
        ("constraints.tip={of: {reach: {body: finger, goal: target}}}", "constraints.tip: needs `at_least`"),
        ("constraints.tip.of.reach.group=tpi", "constraints.tip.of.reach.group: there is no group of the body"),
        ("constraints.tip.of.reach.weight=5", "constraints.tip.of.reach.weight: a constraint has no weight"),
        ("constraints.tip.at_most=-0.1", "constraints.tip.at_most: -0.1 can never be met: no reach is below 0"),
        ("constraints.tip={of: {effort: {}}, equals: -1}", "constraints.tip.equals: -1 can never be met: no effort is"),
        ("constraints.up.scale=0", "constraints.up.scale: must be greater than 0"),
        (f"unknowns.{STIFFNESS}.resolution=3", "resolution: has a meaning only for `per: field`"),
        (f"unknowns.{STIFFNESS}={{bounds: [5, 20], mirror: x}}", "mirror: has a meaning only for `per: group`"),
        (f"unknowns.{STIFFNESS}.regulariser=-1", "regulariser: must be at least 0, is -1"),
        (f"unknowns.{STIFFNESS}.mirror=z", "mirror: a 2D world has no axis z"),
        (f"unknowns.{STIFFNESS}.mirror=y", "of 48 particles of 'finger' have no mirror image across y, the first at"),
    ],
)
def test_bad_input_is_told(finger, tmp_path, override, message):
    with pytest.raises(SceneError) as caught:
        learn(finger, tmp_path, override)
    assert message in str(caught.value)
