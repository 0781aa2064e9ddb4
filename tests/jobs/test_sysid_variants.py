"""Recordings with scenes of their own: other bodies, one that blows up, tied starts; what cannot be told apart."""

from __future__ import annotations

import re
import shutil

import numpy as np
import pytest
from small_beam import E_PATH, SHEAR_PATH, Listener, changed, record, recorded, result_of

from cqrun.build.model import build
from cqrun.cli.results import draw_and_print_run
from cqrun.errors import SceneError, Stopped, UsageError
from cqrun.fitting.cases import make_cases
from cqrun.jobs.resume import run_resume
from cqrun.jobs.simulate import run_simulate
from cqrun.jobs.sysid import run_sysid, with_optimizer
from cqrun.jobs.table import report_lines
from cqrun.jobs.validate import validate
from cqrun.scene.load import load_scene
from cqrun.store.run import read_record
from cqrun.store.trajectory import read_trajectory

ONCE = "optimizer={least_squares: {max_iterations: 1}}"
WEIGHT = (
    "data.recordings.{}.overrides.bodies.weight={{shape: {{box: {{corner: [0.10, 0.09], size: [0.02, 0.02]}}}}, "
    "particles_per_cell: 4, material: {{density: 1000, elastic: {{fixed_corotated: {{youngs_modulus: 3.0e4, "
    "poissons_ratio: 0.3}}}}, viscosity: {{shear: 3}}}}}}"
)
LINEAR = (
    "loads={a: {damping: {rate: 1.0}}, b: {damping: {rate: 1.0}}}",
    "unknowns={loads.a.damping.rate: {bounds: [0.1, 10], also: [loads.b.damping.rate]}}",
)


@pytest.fixture
def two(fit, tmp_path):
    """Return a scene of two recordings."""
    files = record(fit, tmp_path / "data", copies=2)
    return recorded(fit, dict(zip(("one", "two"), files, strict=True)))


def find(scene, out, *overrides):
    return run_sysid(scene, list(overrides), out, threads=1)


@pytest.mark.parametrize("name", ["one", "two"])
def test_a_body_that_one_recording_has(two, tmp_path, name):
    """Its own neighbours are counted, whichever recording has it."""
    extra = WEIGHT.format(name).replace(".overrides.bodies.weight=", ".overrides={bodies.weight: ") + "}"
    result = result_of(find(two, tmp_path, extra, ONCE))
    assert set(result["fracture"]) == {"beam", "weight"}


@pytest.mark.parametrize("name", ["one", "two"])
def test_one_held_out_blows_up(two, tmp_path, name):
    """Wherever it stands, the others' findings and trajectory are written."""
    blown = f"data.recordings.{name}.overrides={{world.gravity: [5000, 0]}}"
    run = find(two, tmp_path, blown, f"data.recordings.{name}.holdout=true", ONCE)
    result = result_of(run)
    assert result["recordings"][name]["rmse_mm"] is None
    assert any(f"{name}: held out, and it blows up" in text for text in result["findings"])
    assert (run / "trajectory.h5").exists()


def test_how_well_markers_fit_their_rest_positions_is_told(fit, tmp_path):
    (file,) = record(fit, tmp_path / "data")
    scene = recorded(fit, {"one": file}, still="[0, 0.02]", start="0.02", length="0.06")
    run = find(scene, tmp_path, ONCE)
    found = result_of(run)["recordings"]["one"]["alignment_mm"]
    assert found.keys() == {"tip", "middle"}
    told = f"one: aligned to the rest positions within {min(found.values()):.2f} to {max(found.values()):.2f} mm"
    assert told in (run / "log.txt").read_text()
    assert told in report_lines(run)


def test_what_half_the_substep_would_find_is_told(fit, tmp_path):
    """It is where a fit with half the substep ends, to first order. A run's own data have no other substep."""
    (file,) = record(fit, tmp_path / "data")
    twin = result_of(run_sysid(fit, [], tmp_path, threads=1))
    assert not any("half the substep" in text for text in twin["findings"])
    scene = recorded(fit, {"one": file})
    known = (f"unknowns.{SHEAR_PATH}=null", f"{SHEAR_PATH}=6")
    coarse, fine = (result_of(find(scene, tmp_path, f"time.substeps={n}", *known)) for n in (24, 48))
    (told,) = (text for text in coarse["findings"] if "half the substep" in text)
    value = float(re.search("to about ([^,]+), out of its interval", told)[1])
    start, end = (found["unknowns"][E_PATH]["value"] for found in (coarse, fine))
    assert not coarse["unknowns"][E_PATH]["interval"][0] <= end <= coarse["unknowns"][E_PATH]["interval"][1]
    assert abs(value - end) < 0.25 * abs(end - start)  # the modulus itself changes by a tenth


def test_values_for_groups_and_what_follows_come_with_a_replay(fit, tmp_path):
    """Also into a run that is stopped, and after the run that found them is gone."""
    changed(fit, "scale: log}\n  bodies.beam.material.visc", "scale: log, per: group}\n  bodies.beam.material.visc")
    changed(fit, "bounds: [0.5, 20], scale: log", "bounds: [0.5, 20], also: {world.gravity.1: {factor: -3}}")
    run = find(fit, tmp_path, ONCE)
    with pytest.raises(UsageError, match=rf"-o {E_PATH}=4e4: .* has a value of it for every group"):
        run_simulate(run, [f"{E_PATH}=4e4"], tmp_path, threads=1)
    tip = "{box: {corner: [0.08, 0.06], size: [0.05, 0.01]}}"
    with pytest.raises(UsageError, match=r"holds 1 numbers of .*; this scene's unknowns have \(2,\)"):
        run_simulate(run, [f"bodies.beam.groups.tip={tip}"], tmp_path, threads=1)
    with pytest.raises(Stopped):
        run_simulate(run, [], tmp_path / "again", threads=1, reporter=Listener(stop_after=3))
    found = read_trajectory(run / "trajectory.h5")
    shutil.rmtree(run)
    (replay,) = (tmp_path / "again" / "fit").iterdir()
    run_resume(replay, [], threads=1)
    again = read_trajectory(replay / "trajectory.h5")
    np.testing.assert_array_equal(again.fields["x"], found.fields["x"])
    assert again.provenance["found"] == {E_PATH: found.provenance["found"][E_PATH]}  # the others are in its scene


def test_starts_that_are_tied(two, tmp_path):
    """The second follows the first, and may be anywhere that the first's bounds take it."""
    tied = (
        "unknowns={data.recordings.one.start: {bounds: [0.0, 0.02], initial: 0.01, also: [data.recordings.two.start]}}"
    )
    often = "optimizer={least_squares: {max_iterations: 3}}"
    result = result_of(find(two, tmp_path, tied, "time.duration=0.05", often))
    assert 0.0 <= result["unknowns"]["data.recordings.one.start"]["value"] <= 0.02


MUSCLE = (
    "actuators={muscle: {muscle: {body: beam, axis: [1, 0], strength: 10}}}",
    "activation={signals: {muscle: [0, 1, 0, -1]}}",
)


@pytest.mark.parametrize("interpolate", ["hold", "linear"])
def test_signals_keep_their_time_whatever_is_compared_of_it(two, interpolate):
    """A recording of half the length has the first half of them, and one that is longer the last value after it."""
    lengths = ["data.recordings.one.length=0.05", "data.recordings.two.length=0.1", "time.duration=0.08"]
    built = build(load_scene(two, [*MUSCLE, f"activation.interpolate={interpolate}", *lengths]))
    whole = built.assembly.actuation.activations(0, {})
    short, longer = (case.built.assembly.actuation.activations(0, {}) for case in make_cases(built))
    np.testing.assert_array_equal(short, whole[:5])
    np.testing.assert_array_equal(longer[:8], whole)
    assert set(longer[8:, 0]) == {-1.0}
    own = build(load_scene(two, [*MUSCLE, "data.recordings.one.overrides={activation.over: 0.02}"]))
    assert make_cases(own)[0].built.assembly.actuation.activations(0, {})[2, 0] == -1.0


def test_a_recording_begins_where_its_unknown_start_does(two):
    """Given by `initial`, or by the start that it follows."""
    first = (
        "unknowns={data.recordings.one.start: {bounds: [0.03, 0.05], initial: 0.04, also: [data.recordings.two.start]}}"
    )
    for case in make_cases(build(load_scene(two, [first, "time.duration=0.05"]))):
        assert case.start == 0.04
        assert np.isfinite(case.still_losses()).all()


def test_other_jobs_want_no_recordings(two):
    """`cqrun validate` checks a scene for its job."""
    absent = "data.recordings.one.file=absent.csv"
    with pytest.raises(SceneError, match=r"there is no file .*absent.csv"):
        list(validate(two, [absent]))
    assert any("a valid scene" in line for line in validate(two, [absent, "job=simulate"]))


REFUSED = {
    "what a controller does": (
        (*MUSCLE[:1], "controller={sinusoid: {frequency: 1}}"),
        "controller: sysid drives actuators by `activation` only, not by a controller: remove it",
    ),
    "particles of its own": (
        (f"unknowns={{{E_PATH}: {{bounds: [1.0e4, 1.0e5], per: particle}}}}",
         "data.recordings.two.overrides={bodies.beam.particles_per_cell: 9}", "optimizer={lbfgs: {}}"),
        "data.recordings.two: its overrides change the particles of 'beam', and the unknown",
    ),
    "another grid": (
        (f"unknowns={{{E_PATH}: {{bounds: [1.0e4, 1.0e5], per: field}}}}",
         "data.recordings.two.overrides={world.dx: 0.008}", "optimizer={lbfgs: {}}"),
        "data.recordings.two: its overrides change the particles of 'beam'",
    ),
    "what follows": (
        (*LINEAR, "data.recordings.two.overrides={loads.b.damping.rate: 15}"),
        "follows the unknown 'loads.a.damping.rate': a recording cannot have its own value",
    ),
    "a held-out follower": (
        ("unknowns={data.recordings.one.start: {bounds: [0, 0.02], initial: 0.01, also: [data.recordings.two.start]}}",
         "data.recordings.two.holdout=true"),
        "the recording 'two' is held out, so nothing determines its start",
    ),
    "differences of rounding": (
        ("precision=float32",),
        "optimizer.least_squares: `precision: float32` is too coarse for its finite differences",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be(two, tmp_path, name):
    overrides, message = REFUSED[name]
    with pytest.raises(SceneError, match=re.escape(message)):
        find(two, tmp_path / "out", *overrides)
    assert not (tmp_path / "out").exists()
    with pytest.raises(SceneError, match=re.escape(message)):
        list(validate(two, list(overrides)))


@pytest.mark.slow
def test_single_precision_has_no_intervals(two, tmp_path):
    run = find(two, tmp_path, "precision=float32", "optimizer={lbfgs: {max_iterations: 2}}")
    entry = result_of(run)["unknowns"][SHEAR_PATH]
    assert entry["interval"] is None
    assert "too coarse for the finite differences" in entry["reason"]


@pytest.mark.usefixtures("pictures")
@pytest.mark.parametrize("spread", ["per: field, resolution: 2", "per: particle, mirror: y"])
def test_values_that_follow_from_fewer_numbers(two, tmp_path, spread):
    """The values have no intervals; an unknown that is fitted with them has one."""
    overrides = [f"unknowns.{E_PATH}={{bounds: [1.0e4, 1.0e5], {spread}}}", "optimizer={lbfgs: {max_iterations: 2}}"]
    run = find(two, tmp_path, *overrides)
    found = result_of(run)["unknowns"]
    assert len(found[E_PATH]["value"]) == 40
    assert found[E_PATH]["interval"] is None
    assert "its values follow from fewer numbers" in found[E_PATH]["reason"]
    shear = found[SHEAR_PATH]
    assert shear["interval"][0] < shear["value"] < shear["interval"][1]
    draw_and_print_run(run, quiet=True, allow_plugins=False)
    assert (run / "figures" / "convergence.png").exists()


def test_what_a_recordings_own_scene_warns_of_is_told(two, tmp_path):
    few = "data.recordings.two.overrides={bodies.beam.particles_per_cell: 1}"
    told = "two: .*1 particles in a cell are few"
    assert any(re.search(f"warning: {told}", line) for line in validate(two, [few]))
    listener = Listener()
    run_sysid(two, [few, ONCE], tmp_path, threads=1, reporter=listener)
    assert [line for line in listener.said if re.match(f"warning: {told}", line)]


@pytest.mark.parametrize(
    ("override", "name"),
    [
        (f"unknowns.{E_PATH}.per=group", "least_squares"),
        (f"unknowns.{E_PATH}.per=particle", "lbfgs"),
        ("precision=float32", "lbfgs"),
    ],
)
def test_the_optimizer_that_suits(two, override, name):
    chosen = with_optimizer(load_scene(two, ["optimizer=null", override])).optimizer
    assert chosen.name == name


# --- stopped and extended -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", ["1", "+1", "0x1", "2"])
def test_a_finished_run_is_not_shortened(two, tmp_path, value):
    run = find(two, tmp_path, "optimizer={lbfgs: {max_iterations: 2}}")
    before = result_of(run)
    with pytest.raises(UsageError, match=r"has done 2 iterations, and can only be extended: give more"):
        run_resume(run, [f"optimizer.lbfgs.max_iterations={value}"], threads=1)
    assert result_of(run) == before


def test_a_stopped_run_says_where_it_stands(two, tmp_path):
    words = ["optimizer={adam: {max_iterations: 9}}"]
    with pytest.raises(Stopped):
        run_sysid(two, words, tmp_path, threads=1, reporter=Listener(stop_after=4))
    (record_file,) = tmp_path.glob("fit/*/run.json")
    run = record_file.parent
    result = result_of(run)
    assert (result["status"], read_record(run)["status"]) == ("stopped", "stopped")
    entry = result["unknowns"][SHEAR_PATH]
    assert entry["value"] != entry["initial"]
    assert entry["interval"] is None
    run_resume(run, [], threads=1)
    assert result_of(run)["status"] == "iteration_limit"


def test_an_extended_run_that_is_stopped_says_so(two, tmp_path):
    run = find(two, tmp_path, "optimizer={adam: {max_iterations: 2}}")
    with pytest.raises(Stopped):
        run_resume(run, ["optimizer.adam.max_iterations=9"], threads=1, reporter=Listener(stop_after=2))
    result = result_of(run)
    assert result["status"] == "stopped"
    assert 2 < result["iterations"] < 9


def test_an_extended_run_keeps_its_scene(two, tmp_path):
    run = find(two, tmp_path, "optimizer={lbfgs: {max_iterations: 1}}")
    run_resume(run, ["optimizer.lbfgs.max_iterations=2"], threads=1)
    text = (run / "scene.yaml").read_text()
    (run / "scene.yaml").write_text(text.replace("density: 1000", "density: 1100"))
    with pytest.raises(UsageError, match=r"scene.yaml: has changed since the run began"):
        run_resume(run, ["optimizer.lbfgs.max_iterations=3"], threads=1)
    (run / "scene.yaml").write_text(text)
    run_resume(run, ["optimizer.lbfgs.max_iterations=3"], threads=1)
