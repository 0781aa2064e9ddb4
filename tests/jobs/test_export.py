"""`cqrun export RUN --design`: what the files say of the designed body."""

from __future__ import annotations

import csv
import sys

import h5py
import numpy as np
import pytest
import trimesh
from small_beam import Listener, changed, result_of
from small_finger import FINGER

from cqrun.build.model import build
from cqrun.errors import MissingExtra, Stopped, UsageError
from cqrun.figures.colours import material_of
from cqrun.figures.run_data import read_run
from cqrun.jobs.control import run_codesign, run_control
from cqrun.jobs.export import _outline, _surface, designed, export_design, table
from cqrun.jobs.simulate import run_simulate
from cqrun.learning.agent import FILE
from cqrun.learning.replay import learned_in
from cqrun.running.bodies import point
from cqrun.running.tables import number
from cqrun.scene.load import load_scene

E = "bodies.finger.material.elastic.fixed_corotated.youngs_modulus"
TALL, ABOVE = "bodies.finger.parts.tip.box.size.1", "bodies.finger.material.density"


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Return the small finger: stiffness a particle, and a tip whose height the density follows."""
    path = tmp_path_factory.mktemp("export") / "finger.yaml"
    unknowns = (
        f"unknowns:\n  {E}: {{bounds: [5, 20], per: particle}}\n"
        f"  {TALL}: {{bounds: [0.5, 1], initial: 0.8, also: {{{ABOVE}: {{factor: 0.5, offset: 0.5}}}}}}\n"
    )
    path.write_text(FINGER.replace("job: control", "job: codesign") + unknowns)
    changed(path, "duration: 0.1", "duration: 0.05")
    changed(path, ", spread: [0.05, 0.05]", "")
    changed(path, "episodes: {count: 2, unseen: 1}\n", "")
    return path


@pytest.fixture(scope="module")
def run(scene):
    """Return a run of the scene."""
    return run_codesign(scene, [], scene.parent / "out", threads=1)


def test_the_table_has_the_designed_body(run, tmp_path):
    paths = export_design(run, tmp_path / "design")
    assert [path.name for path in paths] == ["design.csv", "design.vtkhdf", "outline_finger.csv"]
    rows = list(csv.DictReader(paths[0].read_text().splitlines()))
    found = result_of(run)["unknowns"]
    assert [float(row["fixed_corotated.youngs_modulus [Pa]"]) for row in rows] == found[E]["value"]
    tall = found[TALL]["value"]
    assert tall != 0.8
    tip = [row for row in rows if row["groups"] == "tip"]
    assert len(tip) == 16
    y = np.array([float(row["y [m]"]) for row in tip])
    assert np.ptp(y) == pytest.approx(0.2 * tall * 3 / 4)  # four rows in its height, on a scale of .2
    assert all(float(row["density [kg/m^3]"]) == pytest.approx(0.5 * tall + 0.5) for row in rows)
    assert all(float(row["area [m^2]"]) == pytest.approx(0.2**2 * tall / 16) for row in tip)
    assert {row["muscle.left strength [Pa]"] for row in rows if row["groups"] == "left"} == {"4.0"}
    assert {row["muscle.left strength [Pa]"] for row in rows if row["groups"] != "left"} == {""}
    assert all(float(row["mass [kg/m]"]) == pytest.approx(tall * (0.5 * tall + 0.5)) for row in tip)  # unit mass


def test_the_best_design_so_far_of_a_run_that_was_stopped(scene, tmp_path):
    with pytest.raises(Stopped):
        run_codesign(scene, [], tmp_path, threads=1, reporter=Listener(stop_after=2))
    (stopped,) = (tmp_path / "finger").iterdir()
    listener = Listener()
    table, *_ = export_design(stopped, tmp_path / "design", listener)
    assert listener.said == ["the run is not finished: its best design so far is exported"]
    stiffness = [
        float(row["fixed_corotated.youngs_modulus [Pa]"]) for row in csv.DictReader(table.read_text().splitlines())
    ]
    best = learned_in(stopped / FILE)
    assert stiffness == best[E].tolist()
    assert np.ptp(stiffness) > 0
    ended = run_codesign(scene, [], tmp_path, threads=1)
    assert result_of(ended)["unknowns"][E]["value"] != stiffness


def test_paraviews_file_has_the_same(run, tmp_path):
    export_design(run, tmp_path)
    rows = list(csv.DictReader((tmp_path / "design.csv").read_text().splitlines()))
    with h5py.File(tmp_path / "design.vtkhdf") as file:
        group = file["VTKHDF"]
        assert group.attrs["Type"] == b"PolyData"
        assert list(group["NumberOfPoints"]) == [len(rows)] == list(group["Vertices/NumberOfCells"])
        np.testing.assert_array_equal(group["Points"][:, 1], [float(row["y [m]"]) for row in rows])
        assert not group["Points"][:, 2].any()
        own = group["PointData/fixed_corotated.youngs_modulus [Pa]"]
        np.testing.assert_array_equal(own, [float(row["fixed_corotated.youngs_modulus [Pa]"]) for row in rows])


def test_the_table_has_where_an_actuator_lies_and_how_a_body_starts():
    weight = "actuators.muscle.muscle.weight"
    unknown = f"unknowns.{weight}={{bounds: [0, 1], per: particle}}"
    built = build(load_scene(FINGER, ["bodies.finger.velocity=[0, 2]", unknown]))
    columns = table(built, {weight: np.linspace(0, 1, 48)})
    left = built.particles.groups("finger")["left"]
    np.testing.assert_allclose(columns["muscle.left strength [Pa]"][left], 4 * np.linspace(0, 1, 48)[left])
    np.testing.assert_array_equal(columns["velocity y [m/s]"], 2.0)


def test_the_outline_of_a_slice(tmp_path):
    x = np.stack(np.meshgrid(*[0.05 + 0.1 * np.arange(n) for n in (40, 10)], indexing="ij"), axis=-1).reshape(-1, 2)
    _outline(x, np.full(len(x), 0.01), tmp_path / "bar.csv")
    table = np.loadtxt(tmp_path / "bar.csv", delimiter=",", skiprows=1)
    assert set(table[:, 0]) == {0.0}
    a, b = table[:, 1:].T
    assert 0.5 * abs(a @ np.roll(b, 1) - b @ np.roll(a, 1)) == pytest.approx(4.0, rel=2e-3)


@pytest.mark.parametrize("across", [3, 5])
def test_what_is_thin_encloses_what_its_particles_fill(tmp_path, across):
    """Smoothed over two particles, a body that is few across is half full nowhere near its surface."""
    x = np.stack(np.meshgrid(*[np.arange(n) + 0.5 for n in (20, across, across)], indexing="ij"), axis=-1).reshape(
        -1, 3
    )
    _surface(0.1 * x, np.full(len(x), 1e-3), tmp_path / "leg.stl")
    mesh = trimesh.load_mesh(tmp_path / "leg.stl")
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(1e-3 * len(x), rel=2e-3)
    assert np.allclose(mesh.center_mass, [1.0, 0.05 * across, 0.05 * across], atol=0.01)  # a tenth of a distance


def test_the_outline_of_a_ring_leaves_its_hole(tmp_path):
    x = np.stack(np.meshgrid(*[0.05 + 0.1 * np.arange(40)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    far = np.linalg.norm(x - 2.0, axis=1)
    x = x[(far < 1.9) & (far > 1.0)]
    _outline(x, np.full(len(x), 0.01), tmp_path / "ring.csv")
    table = np.loadtxt(tmp_path / "ring.csv", delimiter=",", skiprows=1)
    lines = [table[table[:, 0] == k, 1:].T for k in np.unique(table[:, 0])]
    areas = [0.5 * abs(a @ np.roll(b, 1) - b @ np.roll(a, 1)) for a, b in lines]
    assert len(areas) == 2
    assert max(areas) - min(areas) == pytest.approx(0.01 * len(x), rel=2e-3)


def test_the_surface_of_a_body(tmp_path):
    x = np.stack(np.meshgrid(*[np.arange(24.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    x = 0.1 * x[np.linalg.norm(x - 11.5, axis=1) < 11.0]
    _surface(x, np.full(len(x), 1e-3), tmp_path / "ball.stl")
    mesh = trimesh.load_mesh(tmp_path / "ball.stl")
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(1e-3 * len(x), rel=2e-3)
    assert np.allclose(mesh.center_mass, 1.15, atol=0.01)


def test_the_surface_of_parts_whose_particles_are_not_of_one_size(tmp_path):
    """As in robots whose parts have equal numbers of particles: muscles of a quarter of a block's."""
    fine, coarse = (
        np.stack(np.meshgrid(*[step * (np.arange(n) + 0.5) for n in counts], indexing="ij"), axis=-1).reshape(-1, 3)
        for step, counts in ((0.1 * 4 ** (-1 / 3), (19, 38, 19)), (0.1, (12, 12, 12)))
    )
    coarse[:, 1] += fine[:, 1].max() + 0.08
    volume = np.concatenate([np.full(len(fine), 1e-3 / 4), np.full(len(coarse), 1e-3)])
    _surface(np.concatenate([fine, coarse]), volume, tmp_path / "robot.stl")
    mesh = trimesh.load_mesh(tmp_path / "robot.stl")
    assert mesh.is_watertight
    assert len(mesh.split()) == 1
    assert mesh.volume == pytest.approx(volume.sum(), rel=2e-3)


def test_a_surface_without_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "igl", None)
    with pytest.raises(MissingExtra, match=r"a surface needs igl, which is not installed: pip install 'cqrun\[mesh\]'"):
        _surface(np.zeros((1, 3)), np.ones(1), tmp_path / "ball.stl")


def test_what_is_told_of_a_replay_is_of_the_body_that_acts(run, tmp_path):
    """Its scene says neither how tall the tip is nor how stiff each particle."""
    listener = Listener()
    again = run_simulate(run, [], tmp_path, threads=1, reporter=listener)
    built, values = designed(run)
    inputs = built.assembly.inputs(values)
    m, x = inputs.fields.mass, inputs.state.x
    assert m.sum() != pytest.approx(built.assembly.inputs({}).fields.mass.sum(), rel=1e-3)
    (told,) = (line for line in listener.said if line.startswith("finger: ") and "; mass " in line)
    assert f"mass {number(m.sum())} kg/m; from {point(x.min(axis=0))} to {point(x.max(axis=0))} m" in told
    first, *_, last = csv.DictReader((again / "observables.csv").read_text().splitlines())
    assert [float(first[f"finger.{axis}"]) for axis in "xy"] == pytest.approx(m @ x / m.sum(), rel=1e-12)
    v = h5py.File(again / "trajectory.h5")["particles/v"][-1]
    assert float(last["finger.kinetic_energy"]) == pytest.approx(0.5 * m @ (v**2).sum(axis=1), rel=1e-5)
    stiffness = material_of(read_run(again), built.particles, "stiffness")
    np.testing.assert_array_equal(stiffness, result_of(run)["unknowns"][E]["value"])


def test_a_design_is_replayed_with_its_geometry(run, tmp_path):
    """The trained body is that of the run, not one sampled anew; and its geometry cannot be another."""
    again = run_simulate(run, [], tmp_path, threads=1)
    _, values = designed(run)
    assert values[TALL] == result_of(run)["unknowns"][TALL]["value"]
    (first, last) = (h5py.File(path / "trajectory.h5")["particles/x"][-1] for path in (run, again))
    np.testing.assert_array_equal(first, last)
    with pytest.raises(UsageError, match="is a run of simulate, which designs nothing: export the run that it replays"):
        export_design(again, tmp_path / "design")
    with pytest.raises(UsageError, match="holds the body's geometry, which was learned"):
        run_simulate(run, [f"{TALL}=1.2"], tmp_path, threads=1)


def test_what_has_no_design(run, tmp_path):
    plain = tmp_path / "finger.yaml"
    plain.write_text(FINGER)
    control = run_control(plain, ["time.duration=0.02"], tmp_path / "out", threads=1)
    with pytest.raises(UsageError, match="its scene has no `unknowns`: nothing was designed"):
        export_design(control, tmp_path / "design")
    with pytest.raises(UsageError):
        export_design(tmp_path, tmp_path / "design")
