"""Measured quantities of a scene in every job: their table, trajectory, result, picture and messages."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import yaml
from tiny_beam import BEAM, NU

from cqrun.errors import SceneError, UsageError
from cqrun.figures.draw import draw_run
from cqrun.jobs.control import run_control
from cqrun.jobs.rest import REST
from cqrun.jobs.simulate import run_simulate
from cqrun.jobs.sysid import run_sysid
from cqrun.jobs.validate import validate
from cqrun.measures import material
from cqrun.store.hdf5 import checksum
from cqrun.store.result import read_result
from cqrun.store.trajectory import read_trajectory

BOX = {"corner": [0.18, 0.2], "size": [0.04, 0.04]}
MEASURE: dict[str, Any] = {
    "tip": {"displacement": {"point": [0.215, 0.22]}},
    "bend": {"rotation": {"region": {"box": BOX}}},
    "held": {"reaction": {"boundary": "clamp"}},
    "cable": {"cable_tension": {"cable": "pull"}},
    "motion": {"kinetic_energy": {}},
    "stored": {"elastic_energy": {}},
    "root": {"stress": {"region": {"box": {"corner": [0.04, 0.2], "size": [0.02, 0.02]}}}},
}
NAMES = ["tip.x", "tip.y", "bend", "held.x", "held.y", "cable", "motion", "stored", "root.xx", "root.yy", "root.xy"]


def written(folder: Path, **changes: Any) -> Path:
    """Return the file of the tiny beam with a cable and measured quantities, and other sections."""
    scene = yaml.safe_load(BEAM)
    scene["actuators"] = {"pull": {"cable": {"body": "beam", "route": [[0.05, 0.235], [0.21, 0.235]], "tension": 2.0}}}
    scene["measure"] = MEASURE
    scene |= changes
    path = folder / "beam.yaml"
    path.write_text(yaml.safe_dump(scene, sort_keys=False))
    return path


def table_of(run: Path) -> dict[str, np.ndarray]:
    with (run / "measurements.csv").open() as file:
        head, *rows = list(csv.reader(file))
    return dict(zip(head, np.array([[float(cell or "nan") for cell in row] for row in rows]).T, strict=True))


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("simulated")
    return run_simulate(written(folder, activation={"signals": {"pull": [0.0, 1.0]}}), [], folder / "results")


def test_the_table_has_a_row_for_each_control_step_and_a_column_for_each_number(simulated):
    table = table_of(simulated)
    assert list(table) == ["time", *NAMES]
    assert table["time"] == pytest.approx(0.01 * np.arange(11))
    assert np.isnan(table["held.x"][0])
    assert not any(np.isnan(column[1:]).any() for column in table.values())
    assert table["cable"] == pytest.approx([0.0] * 6 + [2.0] * 5)


def test_quantities_agree_with_the_trajectory(simulated):
    table, trajectory = table_of(simulated), read_trajectory(simulated / "trajectory.h5")
    x, v = trajectory.fields["x"], trajectory.fields["v"]
    end = np.argmin(np.linalg.norm(x[0] - [0.215, 0.215], axis=1))
    moved = x[:, end, 1] - x[0, end, 1]
    assert table["tip.y"][-1] == pytest.approx(moved[-1], rel=0.05)
    mass = 1000 * 0.2 * 0.04 / x.shape[1]
    assert table["motion"] == pytest.approx(0.5 * mass * (v.astype(float) ** 2).sum(axis=(1, 2)), rel=1e-5, abs=1e-12)
    assert table["bend"][-1] < -1e-3


@pytest.mark.parametrize("frame", ["reference", "updated"])
def test_the_work_of_weight_and_actuators_is_found_again_in_motion_and_strain(tmp_path, frame):
    """A cable with a given tension, a muscle and gravity.

    Particles do not see the grid's finest waves, which is 1.4 % here, and half of that on half the cells. In the
    updated frame the grid takes some energy away.
    """
    muscle = {"muscle": {"body": "beam", "axis": [1, 0], "strength": 4.0e3}}
    cable = {"cable": {"body": "beam", "route": [[0.05, 0.235], [0.21, 0.235]], "tension": 50.0}}
    measure = {name: MEASURE[name] for name in ("motion", "stored")} | {"centre": {"displacement": {}}}
    changes = {
        "actuators": {"pull": cable, "flex": muscle}, "time": {"duration": 0.2, "control_step": 0.01},
        "activation": {"signals": {"pull": [0.5, 1.0, 0.2], "flex": [0.0, 1.0]}},
        "measure": measure | {"pulled": {"work": {"actuator": "pull"}}, "flexed": {"work": {"actuator": "flex"}}},
    }  # fmt: skip
    scene = written(tmp_path, **changes)
    table = table_of(run_simulate(scene, ["world.dx=0.01", f"world.frame={frame}"], tmp_path / "results"))
    given = -1000 * 9.81 * 0.2 * 0.04 * table["centre.y"] + table["pulled"] + table["flexed"]
    kept, size = table["motion"] + table["stored"], given.max()
    assert abs(table["pulled"]).max() > 0.03 * size
    assert abs(table["flexed"]).max() > 0.1 * size
    assert table["stored"].max() > 0.2 * size
    assert kept == pytest.approx(given, abs=(0.02 if frame == "reference" else 0.1) * size)


@pytest.mark.slow
@pytest.mark.parametrize("nu", [0.3, 0.499], ids=["local", "averaged"])
def test_what_viscosity_dissipates_is_what_weight_has_done_and_motion_and_strain_have_not(tmp_path, nu):
    """A viscous beam sinks under its weight. The balance is right to 0.16 %, and more than half has become heat."""
    measure = {name: MEASURE[name] for name in ("motion", "stored")} | {"centre": {"displacement": {}}}
    changes = {
        "actuators": {}, "time": {"duration": 0.6, "control_step": 0.01},
        "measure": measure | {"lost": {"dissipated_energy": {}}},
    }  # fmt: skip
    viscous = ["bodies.beam.material.viscosity={shear: 2000, bulk: 1000}", "world.dx=0.01", f"{NU}={nu}"]
    table = table_of(run_simulate(written(tmp_path, **changes), viscous, tmp_path / "results"))
    given = -1000 * 9.81 * 0.2 * 0.04 * table["centre.y"]
    assert table["lost"][-1] > 0.55 * given[-1]
    assert np.all(np.diff(table["lost"]) >= 0.0)
    assert table["motion"] + table["stored"] + table["lost"] == pytest.approx(given, abs=0.003 * given.max())


def test_the_stress_of_a_nearly_incompressible_bar_in_tension_is_its_force_per_area(tmp_path):
    """It is right to 2e-5 over the whole thickness, and to 2e-4 in its inner quarter.

    There, pressures from the particles' own volumes would make it 4 % too small.
    """
    middle = {"region": {"box": {"corner": [0.1, 0.2], "size": [0.04, 0.04]}}}
    inner = {"region": {"box": {"corner": [0.1, 0.215], "size": [0.04, 0.01]}}}
    pulled = {"region": {"box": {"corner": [0.2, 0], "size": [0.2, 0.3]}}, "displacement": [0.016, 0.0]}
    clamp = {"region": {"box": {"corner": [0, 0], "size": [0.04, 0.3]}}}
    measure = {
        "force": {"reaction": {"boundary": "clamp", "on": "boundary"}}, "thinner": {"stretch": middle},
        "middle": {"stress": middle}, "inner": {"stress": inner},
    }  # fmt: skip
    scene = written(
        tmp_path, actuators={}, world={"size": [0.4, 0.3], "dx": 0.01},
        boundaries={"clamp": {"sticky": clamp}, "pull": {"sticky": pulled}}, measure=measure,
    )  # fmt: skip
    table = table_of(REST.run(scene, [f"{NU}=0.499", "job=rest"], tmp_path / "results"))
    pull = table["force.x"][-1] / (0.04 * table["thinner.least"][-1])
    assert pull > 0.1 * 5.0e4
    assert table["middle.xx"][-1] == pytest.approx(pull, rel=1e-4)
    assert table["inner.xx"][-1] == pytest.approx(pull, rel=1e-3)
    assert [table["middle.yy"][-1], table["middle.xy"][-1]] == pytest.approx([0.0, 0.0], abs=2e-4 * pull)


def test_the_trajectory_explains_the_quantities_itself(simulated):
    table = table_of(simulated)
    with h5py.File(simulated / "trajectory.h5") as file:
        tip = file["measured/quantities/tip"]
        assert tip.attrs["unit"] == "m"
        assert tip.attrs["long_name"] == "displacement from rest"
        assert json.loads(tip.attrs["components"]) == ["x", "y"]
        assert np.array_equal(tip[:, 1], table["tip.y"])
        assert np.array_equal(file["measured/time"][:], table["time"])
        assert file["checksums/measured/quantities/tip"][3] == checksum(tip[3])
    measured = read_trajectory(simulated / "trajectory.h5").measured
    assert list(measured.quantities) == list(MEASURE)
    assert list(measured.columns()) == NAMES


def test_a_damaged_quantity_is_refused(simulated, tmp_path):
    copy = tmp_path / "trajectory.h5"
    copy.write_bytes((simulated / "trajectory.h5").read_bytes())
    with h5py.File(copy, "r+") as file:
        file["measured/quantities/bend"][2] += 1.0
    with pytest.raises(UsageError, match="row 2 of 'measured/quantities/bend' is not what was written"):
        read_trajectory(copy)


def test_the_result_has_a_summary_of_every_number(simulated):
    table, measured = table_of(simulated), read_result(simulated).measured
    assert list(measured) == NAMES
    assert measured["tip.y"].end == table["tip.y"][-1]
    assert measured["tip.y"].least == table["tip.y"].min()
    assert measured["held.y"].start == table["held.y"][1]
    assert measured["held.y"].mean == pytest.approx(table["held.y"][1:].mean())
    assert measured["cable"].unit == "N/m"


def test_the_picture_is_drawn(simulated):
    assert simulated / "figures" / "measured.png" in draw_run(simulated)


def test_quantities_of_an_equilibrium_have_a_row_for_each_point(tmp_path):
    scene = written(
        tmp_path,
        path={"activation.pull": [0.0, 1.0]},
        measure=MEASURE
        | {"motion": MEASURE["cable"], "worked": {"work": {"actuator": "pull"}}, "lost": {"dissipated_energy": {}}},
    )
    run = REST.run(scene, [], tmp_path / "results")
    table = table_of(run)
    assert table["point"] == pytest.approx([0, 1, 2])
    weight = 1000 * 9.81 * 0.2 * 0.04
    assert table["held.y"][1:] == pytest.approx(weight * 0.95, rel=0.06)  # what lies in the clamp has no weight there
    assert table["cable"] == pytest.approx([0.0, 0.0, 2.0])
    assert np.isnan(table["worked"]).all()
    assert np.isnan(table["lost"]).all()
    assert list(read_result(run).measured) == NAMES
    assert read_trajectory(run / "trajectory.h5").measured.at_rest
    assert run / "figures" / "measured.png" in draw_run(run)


def test_what_is_zero_at_rest_is_said(tmp_path):
    scene = written(tmp_path, job="rest")
    lines = [line for line in validate(scene) if "motion" in line and "warning" in line]
    assert "says nothing at rest, where nothing moves" in lines[0]


def test_quantities_of_a_fit_are_those_of_its_prediction(tmp_path):
    modulus = "bodies.beam.material.elastic.neo_hookean.youngs_modulus"
    scene = written(
        tmp_path, actuators={}, measure={name: MEASURE[name] for name in ("tip", "held")},
        data={"synthetic": {"body": "beam", "tracked": 3, "every": 2, "truth": {modulus: 6.0e4}}},
        unknowns={modulus: {"bounds": [3.0e4, 9.0e4]}},
    )  # fmt: skip
    run = run_sysid(scene, ["optimizer={least_squares: {max_iterations: 4}}"], tmp_path / "results")
    table = table_of(run)
    assert list(table) == ["time", "tip.x", "tip.y", "held.x", "held.y"]
    assert not np.isnan(table["held.y"][1:]).any()
    assert read_result(run).measured["tip.y"].end == table["tip.y"][-1]


def test_a_controller_learns_from_quantities_and_is_judged_by_them(tmp_path):
    scene = written(
        tmp_path, controller={"linear_tanh": {}},
        observers={"seen": {"measured": {"quantity": "bend"}}},
        objective={
            "far": {"measured": {"quantity": "tip", "target": [0.0, 0.0], "over": "mean", "weight": 1.0e4}},
            "gently": {"measured": {"quantity": "cable", "weight": 1.0e-3}},
        },
        constraints={"force": {"of": {"measured": {"quantity": "held", "component": "y"}}, "at_most": 90.0,
                               "scale": 10.0}},
        optimizer={"slsqp": {"max_iterations": 2}},
    )  # fmt: skip
    run = run_control(scene, [], tmp_path / "results")
    result, table = read_result(run), table_of(run)
    moved = 1.0e4 * (table["tip.x"][1:] ** 2 + table["tip.y"][1:] ** 2).mean()
    assert 1.0e4 * result.trained.terms["far"] == pytest.approx(moved, rel=1e-9)
    assert result.trained.terms["gently"] == pytest.approx(table["cable"][-1], rel=1e-9)
    assert result.constraints["force"].value == pytest.approx(table["held.y"][-1], rel=1e-9)
    assert list(result.measured) == NAMES


@pytest.mark.parametrize("volume", ["local", "averaged"])
def test_a_trajectory_has_strain_and_stress_if_the_scene_asks_for_them(tmp_path, volume):
    scene = written(
        tmp_path, trajectory={"fields": ["strain", "stress"], "frames": 5}, measure={"root": MEASURE["root"]}
    )
    run = run_simulate(scene, [f"world.volume={volume}"], tmp_path / "results")
    trajectory = read_trajectory(run / "trajectory.h5")
    strain, stress = trajectory.fields["strain"], trajectory.fields["stress"]
    assert strain.shape == stress.shape == (6, 80, 3)
    x = trajectory.fields["x"][0]
    root = (x >= [0.04, 0.2]).all(axis=1) & (x <= [0.06, 0.22]).all(axis=1)
    assert stress[-1][root].mean(axis=0) == pytest.approx([table_of(run)[f"root.{c}"][-1] for c in ("xx", "yy", "xy")],
                                                          rel=1e-5)  # fmt: skip
    J = trajectory.fields["J"]
    volume = np.sqrt((1 + 2 * strain[..., 0]) * (1 + 2 * strain[..., 1]) - 4 * strain[..., 2] ** 2)
    assert volume == pytest.approx(J, rel=1e-4)
    with h5py.File(run / "trajectory.h5") as file:
        assert file["particles/stress"].attrs["unit"] == "Pa"
        assert "stress" in file["VTKHDF/PointData"]
    points = REST.run(scene, ["actuators=null", "job=rest"], tmp_path / "results")
    assert read_trajectory(points / "trajectory.h5").fields["stress"].shape == (2, 80, 3)


def test_stress_that_is_not_known_is_refused_before_a_run(tmp_path, monkeypatch):
    scene = written(tmp_path, trajectory={"fields": ["stress"]}, measure={})
    monkeypatch.setattr(material, "has_history", lambda kind: True)
    with pytest.raises(SceneError, match=r"trajectory\.fields: the Cauchy stress of a material with a history is not"):
        list(validate(scene))


def test_validate_lists_the_quantities(tmp_path):
    lines = [re.sub(" +", " ", line) for line in validate(written(tmp_path))]
    assert " measured tip: displacement from rest [m], x, y" in lines
    assert " measured bend: rotation from rest [rad]" in lines


@pytest.mark.parametrize(
    ("section", "value", "message"),
    [
        ("measure", {"tip": {"position": {"point": [0.3, 0.1]}}}, r"measure\.tip\.position: the point is not inside"),
        ("measure", {"tip": {"position": {"group": "hand"}}}, "no group of the body 'beam' 'hand'"),
        ("measure", {"a": {"reaction": {"boundary": "wall"}}}, "there is no boundary 'wall'"),
        ("measure", {"a": {"cable_length": {"cable": "pul"}}}, "there is no actuator 'pul' .did you mean 'pull'"),
        ("measure", {"a": {"bend": {"group": "x"}}}, "to_group"),
        ("measure", {"time": {"position": {}}}, "measure.time: a column of measurements.csv has this name"),
        ("measure", {"x": {"position": {}}}, "the array of positions has this name: give the quantity another one"),
        ("objective", {"a": {"measured": {"quantity": "tp"}}}, "no measured quantity 'tp' .did you mean 'tip'"),
        ("objective", {"a": {"measured": {"quantity": "tip", "component": "z"}}}, "there is no component 'z'"),
        ("objective", {"a": {"measured": {"quantity": "bend", "component": "x"}}}, "leave `component` out"),
        ("objective", {"a": {"measured": {"quantity": "tip", "target": 1.0}}}, "give 2 .x, y., or a `component`"),
        ("observers", {"a": {"measured": {"quantity": "stored"}}}, "a controller cannot see 'stored'"),
    ],
)
def test_what_does_not_fit_is_reported_at_its_place(tmp_path, section, value, message):
    learns = {"controller": {"linear_tanh": {}}, "objective": {"a": {"measured": {"quantity": "tip"}}}}
    if section == "measure":
        learns = {}
    path = written(tmp_path, **{**learns, section: value})
    with pytest.raises(SceneError) as error:
        list(validate(path))
    assert re.search(message, str(error.value))


def test_reactions_need_the_reference_frame(tmp_path):
    path = written(tmp_path, world={"size": [0.4, 0.3], "dx": 0.02, "frame": "updated"})
    with pytest.raises(SceneError, match=r"measure\.held\.reaction: .*reference"):
        list(validate(path))


def test_a_scene_without_quantities_keeps_the_name_of_its_run(tmp_path):
    run = run_simulate(written(tmp_path, measure={}, actuators={}), [], tmp_path / "results")
    assert not (run / "measurements.csv").exists()
    assert "measure" not in (run / "scene.yaml").read_text()
    assert "measured" not in (run / "result.json").read_text()
