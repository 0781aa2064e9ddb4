"""Comparisons of runs: groups, labels, and the band around their mean."""

from __future__ import annotations

import json

import numpy as np
import pytest
from made_runs import history, plane_scene, write_history, write_run
from scipy.stats import t as student

from cqrun.errors import UsageError
from cqrun.figures.ablation import draw_ablation
from cqrun.figures.compare import Group, band, draw_comparison, groups
from cqrun.figures.convergence import draw_convergence
from cqrun.figures.losses import LossCurve
from cqrun.figures.run_data import read_run
from cqrun.figures.style import COLOURS, styled


def make_run(out, digest, *, name="twin", seed=0, rows=5, speed=1.0, **more):
    path = write_run(out, plane_scene({}, seed=seed, **more), name=f"{name}/{digest}", status="running")
    columns = history(rows, {})
    columns["loss"] = columns["loss"] * (1 + 0.1 * seed)
    columns["seconds"] = 50.0 * seed + speed * columns["iteration"]
    write_history(path, columns)
    return read_run(path)


def test_runs_that_differ_only_in_their_seed_are_one_group(tmp_path):
    runs = [make_run(tmp_path, f"{k}" * 12, seed=k) for k in range(3)]
    (group,) = groups(runs)
    assert group.label == "twin"
    assert len(group.curves) == 3


def test_labels_contain_the_differences(tmp_path):
    finer = {"size": [0.2, 0.1], "dx": 0.005, "gravity": [0.0, -9.81], "frame": "updated"}
    runs = [
        make_run(tmp_path, "a" * 12),
        make_run(tmp_path, "b" * 12, world=finer),
        make_run(tmp_path, "c" * 12, optimizer={"adam": {"learning_rate": 0.05}}),
        make_run(tmp_path, "d" * 12, name="other"),
    ]
    assert [group.label for group in groups(runs)] == [
        "twin, least_squares, world.dx 0.01",
        "twin, least_squares, world.dx 0.005",
        "twin, adam, world.dx 0.01",
        "other",
    ]


def test_runs_with_many_differences_are_labelled_by_their_hash(tmp_path):
    other = {
        "world": {"size": [0.3, 0.2], "dx": 0.005, "frame": "updated"},
        "time": {"duration": 1.0, "control_step": 0.02, "substeps": 9},
    }
    labels = [group.label for group in groups([make_run(tmp_path, "a" * 12), make_run(tmp_path, "b" * 12, **other)])]
    assert labels == ["twin " + "a" * 12, "twin " + "b" * 12]


def test_the_band_is_the_student_interval_of_the_geometric_mean():
    values = np.array([[8.0, 4.0, 2.0], [8.0, 2.0, 1.0], [8.0, 3.0, 1.5]])
    curves = tuple(LossCurve("RMSE", np.arange(3.0), np.arange(3.0), row) for row in values)
    result = band(Group("g", curves), over_time=False)
    logs = np.log(values)
    half = student.ppf(0.95, 2) * logs.std(axis=0, ddof=1) / np.sqrt(3)
    np.testing.assert_array_equal(result.x, [0, 1, 2])
    np.testing.assert_allclose(result.mean, np.exp(logs.mean(axis=0)))
    np.testing.assert_allclose(result.low, np.exp(logs.mean(axis=0) - half))
    np.testing.assert_allclose(result.high, np.exp(logs.mean(axis=0) + half))


def test_the_mean_of_a_signed_loss_is_arithmetic():
    values = np.array([[0.1, -0.4], [0.0, -0.6], [0.2, -0.5]])
    curves = tuple(LossCurve("loss", np.arange(2.0), np.arange(2.0), row, unit="", log=False) for row in values)
    result = band(Group("g", curves), over_time=False)
    half = student.ppf(0.95, 2) * values.std(axis=0, ddof=1) / np.sqrt(3)
    np.testing.assert_allclose(result.mean, values.mean(axis=0))
    np.testing.assert_allclose(result.low, values.mean(axis=0) - half)
    np.testing.assert_allclose(result.high, values.mean(axis=0) + half)


def make_control_run(out, digest, *, seed, far, objective=None, **more):
    """Return a control run with given values of the term `far` of its objective."""
    objective = objective or {"far": {"distance": {"body": "a", "axis": "x"}}}
    scene = plane_scene({}, seed=seed, objective=objective, **more)
    scene = {key: value for key, value in scene.items() if key not in ("data", "job")}
    path = write_run(out, scene, name=f"biped/{digest}", job="control", status="running")
    k = np.arange(len(far), dtype=float)
    weights = {"grad:controller.weights": 1.0 + k, "grad:controller.bias": 0.1 + k}
    write_history(path, {"iteration": k, "loss": 1e-3 - far, "far": far} | weights | {"seconds": 4.0 + 300.0 * k})
    return read_run(path)


def test_a_term_of_the_objective_can_be_compared(tmp_path):
    far = np.array([-0.1, 0.2, 0.5])
    runs = [make_control_run(tmp_path, f"{k}" * 12, seed=k, far=far + 0.01 * k) for k in range(4)]
    with styled():
        figure = draw_comparison(runs, "far")
        figure.draw_without_rendering()
    by_iteration, by_time = figure.axes
    assert (by_iteration.get_title(loc="left"), by_iteration.get_yscale()) == ("Far", "linear")
    np.testing.assert_allclose(by_iteration.lines[-1].get_ydata(), far + 0.015)
    assert by_time.get_xlabel() == "wall time since the first evaluation (min)"
    assert by_time.lines[-1].get_xdata()[-1] == pytest.approx(10)
    assert figure.legends[0].get_texts()[0].get_text() == "biped: mean of 4 seeds and its 90 % interval"
    with pytest.raises(UsageError, match=r"no term or constraint 'fat' \(did you mean 'far'\?\); there are: far"):
        draw_comparison(runs, "fat")


def test_violations_are_compared_on_a_logarithmic_axis(tmp_path):
    runs = [make_control_run(tmp_path, f"{k}" * 12, seed=k, far=np.zeros(3)) for k in range(2)]
    for run in runs:
        run.history["violation"] = np.array([0.5, 1e-3, 0.0])
    with styled():
        figure = draw_comparison(runs, "violation")
        figure.draw_without_rendering()
    assert (figure.axes[0].get_title(loc="left"), figure.axes[0].get_yscale()) == ("Violation", "log")


def test_two_runs_are_lines_and_a_repeated_run_is_not_a_seed(tmp_path):
    far = np.array([0.0, 0.5])
    two = [make_control_run(tmp_path, f"{k}" * 12, seed=k, far=far) for k in range(2)]
    same = [make_control_run(tmp_path, f"{k}a" * 6, seed=0, far=far) for k in range(2)]
    for runs, labels in (
        (two, ["biped: seed 0", "biped: seed 1"]),
        (same, ["biped: 0a0a0a0a0a0a", "biped: 1a1a1a1a1a1a"]),
    ):
        with styled():
            figure = draw_comparison(runs)
        assert [text.get_text() for text in figure.legends[0].get_texts()] == labels
        assert [len(axes.lines) for axes in figure.axes] == [2, 2]
        for axes in figure.axes:
            assert [line.get_color() for line in axes.lines] == list(COLOURS[:2])


def test_terms_that_the_optimizer_does_not_report_are_omitted(tmp_path):
    """For example of cma_es, in whose history they are NaN."""
    runs = [make_control_run(tmp_path, f"{k}" * 12, seed=k, far=np.full(3, np.nan)) for k in range(2)]
    for run in runs:
        run.history["loss"] = np.array([3.0, 2.0, 1.0])
    with styled():
        figure = draw_convergence(runs[0])
        draw_comparison(runs)
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["Loss", "Norm of the gradient"]
    message = (
        "the optimizer least_squares reports the loss of every iteration but not its terms, such as 'far'; compare"
    )
    with pytest.raises(UsageError, match=message):
        draw_comparison(runs, "far")


def test_an_ablation_is_drawn_if_the_optimizer_reports_no_terms(tmp_path):
    run = make_control_run(tmp_path, "a" * 12, seed=0, far=np.full(3, np.nan))
    value = {"mean": 0.5, "low": 0.4, "high": 0.6}
    variants = {
        "control": {
            "free": [], "runs": [str(run.path)], "failed": {}, "feasible": None, "terms": {"far": value},
            "constraints": {}, "gain": None, "rate": None,
        }
    }  # fmt: skip
    path = tmp_path / "ablation-1.json"
    facts = {"scene": "biped", "confidence": 0.9, "compared": "far", "better": "greater", "effects": {}}
    path.write_text(json.dumps(facts | {"variants": variants}))
    assert draw_ablation(path) == [tmp_path / "ablation-1.png"]


def test_losses_with_different_terms_are_not_compared(tmp_path):
    near = {"far": {"distance": {"body": "a", "axis": "x"}}, "work": {"effort": {"weight": 0.1}}}
    heavy = near | {"work": {"effort": {"weight": 0.2}}}
    far = np.array([0.0, 0.5])
    runs = [
        make_control_run(tmp_path, f"{k}" * 12, seed=0, far=far, objective=o) for k, o in enumerate((near, near, heavy))
    ]
    assert len(groups(runs[:2])) == 1
    with pytest.raises(UsageError) as error:
        groups(runs)
    assert str(error.value) == (
        "these runs minimise different things, which one axis cannot compare: "
        f"{runs[0].path} and {runs[2].path} differ in objective.work; "
        "compare a term that all have with --show TERM: far"
    )
    assert len(groups(runs, "far")) == 2
    other = make_control_run(
        tmp_path, "f" * 12, seed=0, far=far, objective={"wide": {"distance": {"body": "a", "axis": "y"}}}
    )
    with pytest.raises(UsageError, match=r"differ in objective\.far, objective\.work, objective\.wide$"):
        groups([*runs[:2], other])


def test_the_same_objective_in_different_scenes_is_compared(tmp_path):
    """For example with other optimizers or grids; in fits to data the objective of the scene is ignored."""
    far = np.array([0.0, 0.5])
    finer = {"size": [0.2, 0.1], "dx": 0.005, "gravity": [0.0, -9.81]}
    more = [{}, {"world": finer}, {"optimizer": {"adam": {"learning_rate": 0.05}}}, {"seed": 3}]
    runs = [make_control_run(tmp_path, f"{k}" * 12, far=far, **({"seed": 0} | each)) for k, each in enumerate(more)]
    assert len(groups(runs)) == 3
    objectives = [{"work": {"effort": {"weight": weight}}} for weight in (1.0, 2.0)]
    assert len(groups([make_run(tmp_path, f"f{k}" * 6, objective=each) for k, each in enumerate(objectives)])) == 2


def test_a_control_run_shows_its_loss_its_terms_and_its_gradients(tmp_path):
    run = make_control_run(tmp_path, "a" * 12, seed=0, far=np.array([-0.1, 0.2, 0.5]))
    with styled():
        figure = draw_convergence(run)
        figure.draw_without_rendering()
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["Loss", "Far", "Norm of the gradient"]
    gradients = figure.axes[2]
    assert [text.get_text() for text in gradients.get_legend().get_texts()] == ["controller.weights", "controller.bias"]
    np.testing.assert_allclose(gradients.lines[0].get_ydata(), [1, 2, 3])


def test_a_run_that_has_ended_keeps_its_last_value():
    short = LossCurve("RMSE", np.arange(2.0), np.array([10.0, 11.0]), np.array([4.0, 2.0]))
    long = LossCurve("RMSE", np.arange(4.0), np.array([0.0, 1.0, 2.0, 3.0]), np.array([4.0, 2.0, 2.0, 2.0]))
    np.testing.assert_allclose(band(Group("g", (short, long)), over_time=False).mean, [4, 2, 2, 2])
    over_time = band(Group("g", (short, long)), over_time=True)
    assert (over_time.x[0], over_time.x[-1]) == (0.0, 3.0)  # relative to the first evaluation of each run
    assert over_time.mean[-1] == pytest.approx(2)


def test_three_equal_runs_are_a_mean_and_a_band(tmp_path):
    runs = [make_run(tmp_path, f"{k}" * 12, seed=k) for k in range(3)] + [make_run(tmp_path, "f" * 12, name="other")]
    with styled():
        figure = draw_comparison(runs)
        figure.draw_without_rendering()
    by_iteration, by_time = figure.axes
    assert [len(axes.collections) for axes in figure.axes] == [1, 1]
    assert [len(axes.lines) for axes in figure.axes] == [5, 5]
    text = [label.get_text() for label in figure.legends[0].get_texts()]
    assert text == ["twin: geometric mean of 3 seeds and its 90 % interval", "other"]
    np.testing.assert_allclose(by_iteration.lines[4].get_ydata(), 1e3 * np.sqrt(history(5, {})["loss"]))
    np.testing.assert_allclose(by_time.lines[4].get_xdata(), np.arange(5))


def test_the_whole_band_is_visible_unless_it_is_extremely_wide(tmp_path):
    wide = [make_run(tmp_path, f"{k}" * 12, seed=k) for k in range(3)]
    for scale, whole in ((2.0, True), (1e12, False)):
        for run, factor in zip(wide, (1.0, scale, scale**2), strict=True):
            run.history["loss"] = factor * 1e-6 * np.array([4.0, 2.0, 1.0, 1.0, 1.0])
        with styled():
            axes = draw_comparison(wide).axes[0]
        low, high = axes.get_ylim()
        shown = band(groups(wide)[0], over_time=False)
        assert (low < shown.low.min() and shown.high.max() < high) == whole
        assert low > 1e-4  # losses are at least 1 mm


def test_a_loss_of_zero_is_drawn(tmp_path):
    run = make_run(tmp_path, "a" * 12)
    run.history["loss"][-1] = 0.0
    with styled():
        draw_comparison([run, make_run(tmp_path, "b" * 12, name="other")]).draw_without_rendering()


def test_different_losses_are_not_compared(tmp_path):
    there = {"there": {"track": {"body": "b", "keys": [[0.4, 0.1, 0.05]]}}}
    with pytest.raises(UsageError, match="minimise different things"):
        groups([make_run(tmp_path, "a" * 12), make_run(tmp_path, "b" * 12, data=None, objective=there)])
