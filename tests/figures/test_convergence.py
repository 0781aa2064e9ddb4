"""convergence.png shows the numbers of the history, in the units of its labels."""

from __future__ import annotations

import json

import numpy as np
import pytest
from made_runs import YOUNG, history, made_twin, plane_scene, write_history, write_result, write_run
from matplotlib.figure import Figure

from cqrun.errors import UsageError
from cqrun.figures.convergence import draw_convergence, layout, plot_loss, unknown_curves, view
from cqrun.figures.losses import loss_curve
from cqrun.figures.run_data import read_run
from cqrun.figures.style import styled

E = f"bodies.a.{YOUNG}"
DENSITY = "bodies.b.material.density"


@pytest.fixture
def twin(tmp_path, rng):
    return read_run(made_twin(tmp_path, rng))


def curves_of(tmp_path, unknowns, columns, result=None):
    path = write_run(tmp_path, plane_scene(unknowns), status="running")
    rows = next(len(v) for v in columns.values() if v is not None)
    write_history(path, history(rows, columns))
    if result is not None:
        write_result(path, result, None)
    return unknown_curves(read_run(path))


def test_the_loss_is_shown_as_rmse_in_millimetres(twin):
    curve = loss_curve(twin)
    assert curve.label == "RMSE"
    np.testing.assert_allclose(curve.value, 1e3 * np.sqrt(4e-6 * 0.25 ** np.arange(6.0) + 1e-8))
    np.testing.assert_array_equal(curve.seconds, [3, 5, 7, 9, 11, 13])
    assert curve.floor == pytest.approx(0.2 * np.sqrt(2))  # noise 0.2 mm in each of two coordinates
    assert curve.noise == pytest.approx(0.2)


def test_the_noise_is_shown_in_the_sense_of_the_scene_as_well(twin):
    """An RMSE of distances is larger than the noise in each coordinate, which the scene gives."""
    with styled():
        axes = Figure().add_subplot()
        plot_loss(axes, loss_curve(twin))
    (text,) = axes.get_legend().get_texts()
    assert text.get_text() == "noise: 0.283 mm\n(0.200 mm in each coordinate)"


def test_a_fit_to_an_objective_shows_its_loss(tmp_path):
    objective = {"there": {"track": {"body": "b", "keys": [[0.4, 0.1, 0.05]]}}}
    path = write_run(tmp_path, plane_scene({}, data=None, objective=objective), status="running")
    write_history(path, history(2, {}))
    curve = loss_curve(read_run(path))
    assert (curve.label, curve.unit, curve.floor) == ("loss", "", None)


def test_an_unknown_is_shown_in_its_unit_with_interval_and_truth(twin):
    (curve,) = unknown_curves(twin)
    assert (curve.label, curve.unit.name, curve.bounds, curve.log) == ("Young's modulus", "kPa", (100.0, 500.0), True)
    np.testing.assert_allclose(curve.values[:, 0], 300 - 100 * 0.3 ** np.arange(6))
    assert curve.final == pytest.approx([300 - 100 * 0.3**5])
    assert curve.intervals == (pytest.approx((290, 310)),)
    assert curve.truth == pytest.approx(300)


def test_without_a_result_there_are_values_but_no_final_value(tmp_path):
    (curve,) = curves_of(tmp_path, {E: {"bounds": [1e5, 5e5]}}, {E: np.array([2e5, 2.5e5])})
    assert (curve.final, curve.intervals) == (None, ())


def test_groups_have_their_names_and_intervals(tmp_path):
    values = np.array([[2e5, 2e5], [3e5, 1.5e5]])
    result = {E: {"initial": [2e5, 2e5], "value": [3e5, 1.5e5], "interval": [None, [1.4e5, 1.6e5]]}}
    (curve,) = curves_of(tmp_path, {E: {"bounds": [1e5, 5e5], "per": "group"}}, {E: values}, result)
    assert curve.names == ("left", "right")
    np.testing.assert_allclose(curve.values, values / 1e3)
    assert curve.intervals == (None, pytest.approx((140, 160)))


def test_groups_that_share_a_mirrored_value_are_named_together(tmp_path):
    """Left and right share one number, middle has another."""
    scene = plane_scene({E: {"bounds": [1e5, 5e5], "per": "group", "mirror": "x"}})
    middle = {"box": {"corner": [0.04, 0.05], "size": [0.01, 0.02]}}
    scene["bodies"]["a"]["groups"] |= {"middle": middle}
    result = {E: {"initial": [2e5] * 3, "value": [3e5, 3e5, 1.5e5], "interval": None}}
    values = np.array([[2e5, 2e5], [3e5, 1.5e5]])
    for final, names in ((result, ("left, right", "middle")), (None, ("0", "1"))):
        run = tmp_path / str(final is None)
        path = write_run(run, scene, status="iteration_limit")
        write_history(path, history(2, {E: values}))
        if final is not None:
            write_result(path, final, None)
        (curve,) = unknown_curves(read_run(path))
        assert curve.names == names


def test_the_loss_of_a_control_run_is_not_a_distance_even_with_data(tmp_path):
    path = write_run(tmp_path, plane_scene({E: {"bounds": [1e5, 5e5]}}), job="control", status="iteration_limit")
    write_history(path, history(2, {E: np.array([2e5, 3e5])}) | {"loss": np.array([-0.1, -0.4])})
    curve = loss_curve(read_run(path))
    assert (curve.label, curve.unit) == ("loss", "")
    np.testing.assert_array_equal(curve.value, [-0.1, -0.4])


def test_a_large_block_is_shown_by_its_gradient(tmp_path):
    unknowns = {E: {"bounds": [1e5, 5e5]}, DENSITY: {"bounds": [900, 1300], "per": "particle"}}
    result = {
        E: {"initial": 2e5, "value": 3e5, "interval": None},
        DENSITY: {"initial": [1000.0] * 30, "value": [1000.0 + i for i in range(30)], "interval": None},
    }
    _, curve = curves_of(tmp_path, unknowns, {E: np.array([2e5, 3e5, 3e5]), DENSITY: None}, result)
    assert curve.values.shape == (3, 0)
    np.testing.assert_allclose(curve.gradient, 1e-5 * 0.5 ** np.arange(3))
    assert curve.final is not None
    assert curve.final.size == 30


def test_the_range_contains_all_values_and_near_bounds(tmp_path):
    (far,) = curves_of(tmp_path, {DENSITY: {"bounds": [100, 9000]}}, {DENSITY: np.array([1000.0, 1100.0])})
    low, high = view(far)
    assert 900 < low < 1000
    assert 1100 < high < 1200
    (near,) = curves_of(tmp_path / "near", {DENSITY: {"bounds": [950, 1150]}}, {DENSITY: np.array([1000.0, 1100.0])})
    low, high = view(near)
    assert low < 950
    assert high > 1150


def test_a_constant_unknown_has_a_range(tmp_path):
    (curve,) = curves_of(tmp_path, {DENSITY: {"bounds": [900, 1300]}}, {DENSITY: np.array([1000.0, 1000.0])})
    low, high = view(curve)
    assert low < 1000 < high


@pytest.mark.parametrize("panels", range(1, 13))
def test_no_place_remains_empty(panels):
    rows, columns, first = layout(panels)
    assert first + panels - 1 == rows * columns
    assert 1 <= first <= columns <= 3


def test_the_picture_shows_the_numbers(twin):
    with styled():
        figure = draw_convergence(twin)
    loss, unknown = figure.axes
    assert loss.get_title(loc="left") == "RMSE (mm)"
    assert loss.get_yscale() == "log"
    np.testing.assert_array_equal(loss.lines[0].get_xydata(), np.c_[np.arange(6), loss_curve(twin).value])
    assert unknown.get_title(loc="left") == "Young's modulus (kPa)"
    truth, curve = unknown.lines
    assert set(truth.get_ydata()) == {300.0}
    np.testing.assert_array_equal(curve.get_ydata(), unknown_curves(twin)[0].values[:, 0])
    assert [t.get_text() for t in unknown.texts] == ["299.8 (290.0 to 310.0), bounds 100 to 500"]


def test_the_best_iteration_is_marked(tmp_path, rng):
    """The titles of the unknowns show the best parameters, which need not be the last ones."""
    path = made_twin(tmp_path, rng)
    loss = read_run(path).history["loss"]
    write_result(path, {E: {"initial": 2e5, "value": 3e5, "interval": None}}, {"r": {"holdout": False}})
    result = json.loads((path / "result.json").read_text())
    for row, marked in ((len(loss) - 1, False), (2, True)):
        (path / "result.json").write_text(json.dumps(result | {"loss": float(loss[row])}))
        with styled():
            axes = draw_convergence(read_run(path)).axes[0]
        (text,) = [t.get_text() for t in axes.texts]
        assert text.startswith("best: ") == (" after 2; last: " in text) == marked
        assert len([x for x in axes.lines if x.get_marker() == "o" and len(x.get_xdata()) == 1]) == marked


def test_the_wall_time_is_below_the_iterations(twin):
    with styled():
        figure = draw_convergence(twin)
    loss = figure.axes[0]
    text = loss.xaxis.get_major_formatter()
    assert loss.get_xlabel() == "iteration, wall time (s)"
    assert [text(tick, 0) for tick in (-1, 0, 2, 2.5, 99)] == ["", "0\n3", "2\n7", "2.5\n8", ""]


def test_the_interval_is_a_band_inside_the_bounds(tmp_path, rng):
    path = made_twin(tmp_path, rng)
    write_result(path, {E: {"initial": 2e5, "value": 3e5, "interval": [2.9e5, 9e5]}}, {"r": {"holdout": False}})
    with styled():
        axes = draw_convergence(read_run(path)).axes[1]
    bands = [p for p in axes.patches if p.get_label() == "95 % interval"]
    assert len(bands) == 1
    box = bands[0].get_bbox()
    assert (box.y0, box.y1) == pytest.approx((290, 500))


def test_bars_of_several_numbers_have_one_legend_entry_and_marks_where_they_continue(tmp_path):
    path = write_run(tmp_path, plane_scene({E: {"bounds": [1e5, 5e5], "per": "group"}}), status="iteration_limit")
    write_history(path, history(2, {E: np.array([[2e5, 2e5], [3e5, 1.5e5]])}))
    intervals = [[2e5, 9e5], [1.4e5, 1.6e5]]
    write_result(path, {E: {"initial": [2e5, 2e5], "value": [3e5, 1.5e5], "interval": intervals}}, None)
    with styled():
        axes = draw_convergence(read_run(path)).axes[1]
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["truth", "left", "right", "95 % interval"]
    signs = {line.get_marker(): float(line.get_ydata()[0]) for line in axes.lines if line.get_marker() in ("v", "^")}
    assert signs == {"^": pytest.approx(axes.get_ylim()[1])}


@pytest.mark.parametrize("count", [1, 3, 8])
def test_each_of_up_to_eight_unknowns_has_a_panel(tmp_path, count):
    leaves = [YOUNG, "material.elastic.neo_hookean.poissons_ratio", "material.density", "material.viscosity.shear"]
    bounds = [[1e5, 5e5], [0.1, 0.45], [900, 1300], [1, 400]]
    paths = [(f"bodies.{b}.{leaf}", span) for leaf, span in zip(leaves, bounds, strict=True) for b in "ab"][:count]
    path = write_run(tmp_path, plane_scene({p: {"bounds": span} for p, span in paths}), status="running")
    write_history(path, history(4, {p: np.linspace(*span, 4) for p, span in paths}))
    with styled():
        figure = draw_convergence(read_run(path))
        figure.draw_without_rendering()
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert len(set(titles)) == 1 + count


def test_a_history_without_rows_is_an_error(tmp_path):
    with pytest.raises(UsageError, match=r"history\.csv is missing or has no rows yet"):
        loss_curve(read_run(write_run(tmp_path, plane_scene({}), status="running")))
