"""The scene that is proposed for a recording of markers: what is found in it, and that the scene is valid."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from little_worlds import needs_jit
from made_c3d import write_c3d
from made_swing import FREE, HELD, PERIOD, PLACES, RELEASE, SAG, swing
from small_beam import result_of
from twin_recordings import write_twin

from cqrun.errors import DataError, UsageError
from cqrun.jobs.new.fit_scene import fit_scene
from cqrun.jobs.new.lengths import Given
from cqrun.jobs.new.proposal import NOTHING, propose
from cqrun.jobs.new.seen import look
from cqrun.jobs.sysid import run_sysid
from cqrun.jobs.validate import validate
from cqrun.measurements.recording import Recording
from cqrun.scene.load import load_scene
from cqrun.scene.schema import Scene
from cqrun.store.formats.long_table import write_csv
from cqrun.store.history import read_history

REAL = Path(__file__).parents[3] / "shared" / "data" / "realbeam"


def written(
    folder: Path,
    recording: Recording,
    name: str = "swing.csv",
    units: str | None = None,
    given: Given = NOTHING,
) -> tuple[Path, str]:
    """Write a recording, and the scene that is proposed for it; return the scene's file and what there is to check."""
    write_csv(recording, folder / name)
    scene = folder / "fit.yaml"
    proposed = fit_scene(folder / name, scene, units, given)
    scene.write_text(proposed.text)
    return scene, "\n".join(proposed.guesses)


def valid(scene: Path) -> tuple[Scene, list[str]]:
    """Return a scene that is valid without a warning, and what `cqrun validate` says of it."""
    lines = list(validate(scene))
    assert not [line for line in lines if line.startswith("warning")]
    assert len(scene.read_text().splitlines()) <= 50
    assert max(map(len, scene.read_text().splitlines())) <= 130
    return load_scene(scene), lines


# --- what a recording shows -------------------------------------------------------------------------------------


def test_the_rests_and_the_start_are_found():
    seen = look(swing(release=0.7))
    assert seen.still is not None
    assert seen.still[0] < 0.05
    assert 0.6 < seen.still[1] < 0.7
    assert seen.start == pytest.approx(0.7, abs=0.01)
    assert seen.rests[-1][1] == pytest.approx(2.995)  # at its end, the swing has died down
    assert seen.rests[-1][0] > 1.5


def test_a_body_that_turns_around_is_not_at_rest():
    slow = swing(duration=8.0, release=0.5)
    slow = replace(slow, time=20.0 * slow.time)  # a period of 4 s: it is slow for longer than the shortest rest
    (rest, *later) = look(slow).rests
    assert rest[1] == pytest.approx(10.0, abs=0.7)
    assert all(begin > 35.0 for begin, _ in later)


def test_the_rhythm_is_found():
    assert look(swing()).period == pytest.approx(PERIOD, rel=0.05)


def test_what_is_held_and_what_sinks_is_found():
    seen = look(swing(down=(0, -1, 0)))
    assert [n for n, held in zip(seen.names, seen.held, strict=True) if held] == list(HELD)
    np.testing.assert_allclose(seen.drift, [0, -SAG, 0], atol=0.1 * SAG)


def test_a_motion_without_a_rest_begins_at_the_first_frame():
    seen = look(swing(release=0.0, duration=0.5))
    assert (seen.still, seen.start) == (None, 0.0)
    np.testing.assert_allclose(seen.rest, np.add(PLACES, [0.2, -0.3, 0.5]), atol=1e-4)


def test_gaps_do_not_matter():
    recording = swing()
    recording.positions[::7, 1] = np.nan
    recording.positions[300:340, 4] = np.nan
    seen = look(recording)
    assert seen.start == pytest.approx(RELEASE, abs=0.01)
    assert seen.held.sum() == 3


def test_markers_that_cannot_be_used_are_left_out_with_the_reason():
    recording = swing()
    recording.positions[:400, 5] = np.nan
    seen = look(replace(recording, names=("base_1", "twice", "twice", "tip_1", "a\x1bb", "tip_3")))
    assert seen.names == ("base_1", "tip_1")
    assert seen.left_out == (
        "twice (another has the same name)",
        "a\\x1bb (its name cannot be written)",
        "tip_3 (it is rarely seen)",
    )


def test_of_many_markers_those_far_apart_are_chosen():
    recording, n = swing(), 60
    share = np.linspace(0, 1, n)
    x = (1 - share)[:, None] * recording.positions[:, :1] + share[:, None] * recording.positions[:, 3:4]
    seen = look(Recording(recording.time, tuple(f"m{k}" for k in range(n)), x, "made"))
    assert len(seen.names) == 12
    assert {"m0", f"m{n - 1}"} <= set(seen.names)
    assert f"{n - 12} others" in " ".join(seen.left_out)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda r: r.select(["tip_1"]),
            "1 of its 1 markers can be used, and a body cannot be guessed from fewer than 2",
        ),
        (lambda r: r.select(list(HELD)), "no marker moves by more than 0.1"),
        (lambda r: replace(r, time=r.time[:100], positions=r.positions[:100]), "which is no more than the noise"),
    ],
)
def test_a_recording_that_shows_too_little_is_refused(change, message):
    with pytest.raises(DataError, match=message):
        look(change(swing()))


# --- the scene --------------------------------------------------------------------------------------------------


def test_the_scene_has_what_the_recording_shows(tmp_path):
    path, guesses = written(tmp_path, swing())
    scene, lines = valid(path)
    recording = scene.recordings["swing"]
    assert recording.file == "swing.csv"
    assert list(recording.measurement.rest) == [*HELD, *FREE]
    assert recording.start == pytest.approx(RELEASE, abs=0.01)
    assert recording.still[1] < recording.start
    assert scene.world.gravity == [0.0, 0.0, -9.81]
    box = scene.bodies["body"].shape.value
    rest = np.array(list(recording.measurement.rest.values()))
    clamp = scene.boundaries["clamp"].value.region.value
    held, free = rest[:3, 0].max(), rest[3:, 0].min()
    assert clamp.size[0] == pytest.approx(held, abs=1e-4)
    assert box.corner[0] < held < free <= box.corner[0] + box.size[0] + 1e-9
    low, high = scene.unknowns["bodies.body.material.elastic.fixed_corotated.youngs_modulus"].bounds
    expected = 12 * 1070 / 0.03**2 * (2 * np.pi * 0.1**2 / (1.875**2 * PERIOD)) ** 2  # of a beam
    assert low < expected < high
    assert expected == pytest.approx(np.sqrt(low * high), rel=0.3)
    assert "base_1, base_2, base_3" in guesses
    assert any("aligned to the rest positions within 0.0" in line for line in lines)


def test_gravity_is_along_the_axis_in_which_markers_sink(tmp_path):
    path, guesses = written(tmp_path, swing(down=(0, 1, 0)))
    assert valid(path)[0].world.gravity == [0.0, 9.81, 0.0]
    assert "gravity is along +y: from their rest the markers sink that way, by 6 mm" in guesses


def test_a_beam_that_lies_aslant_is_turned(tmp_path):
    path, _ = written(tmp_path, swing(degrees=30.0))
    assert "turned by -30 degrees about the vertical" in path.read_text()
    size = valid(path)[0].bodies["body"].shape.value.size
    assert size[0] > 3 * size[1]


def test_without_a_rest_the_axes_of_the_file_are_shifted(tmp_path):
    path, guesses = written(tmp_path, swing(release=0.0, duration=0.6))
    scene, lines = valid(path)
    recording = scene.recordings["swing"]
    assert (recording.still, recording.start) == (None, 0.0)
    assert recording.measurement.rest["base_1"] == pytest.approx(np.add(recording.offset, [0.2, -0.3, 0.5]), abs=1e-4)
    assert "data.recordings.swing.start" not in scene.unknowns
    assert "the run begins at the first frame" in guesses
    assert any("positions in the scene's own frame" in line for line in lines)


def test_if_all_markers_move_the_end_that_moves_least_is_held(tmp_path):
    path, guesses = written(tmp_path, swing(base=0.3))
    valid(path)
    assert "no marker stands still" in guesses


def test_markers_on_a_line_are_not_aligned(tmp_path):
    recording = swing()
    path, _ = written(tmp_path, recording.select(["base_1", "tip_1"]))
    assert valid(path)[0].recordings["swing"].still is None


def test_a_plane_recording_gives_a_plane_scene(tmp_path):
    recording = swing()
    path, _ = written(tmp_path, replace(recording, positions=recording.positions[..., [0, 2]]))
    scene, _ = valid(path)
    assert scene.world.gravity == [0.0, -9.81]
    assert scene.boundaries["clamp"].value.region.value.size[0] < scene.world.size[0] / 2


def test_a_unit_that_the_file_does_not_state_is_guessed(tmp_path):
    recording = swing()
    path, guesses = written(tmp_path, replace(recording, positions=1e3 * recording.positions))
    scene, _ = valid(path)
    assert scene.recordings["swing"].units == "mm"
    assert "lengths in the file are in mm, so the markers are up to 100 mm apart" in guesses
    size = scene.bodies["body"].shape.value.size
    assert 0.1 < max(size) < 0.2


def test_a_unit_that_is_given_is_used(tmp_path):
    recording = swing()
    path, guesses = written(tmp_path, replace(recording, positions=1e2 * recording.positions), units="cm")
    assert valid(path)[0].recordings["swing"].units == "cm"
    assert "lengths" not in guesses


def test_the_unit_of_a_c3d_file_is_its_own(tmp_path):
    recording = swing()
    file = write_c3d(tmp_path / "Swing 1.c3d", 1e3 * recording.positions, rate=200.0, units="mm", names=recording.names)
    proposed = fit_scene(file, tmp_path / "fit.yaml")
    (tmp_path / "fit.yaml").write_text(proposed.text)
    scene, _ = valid(tmp_path / "fit.yaml")
    assert scene.recordings["swing_1"].units is None
    assert "lengths" not in " ".join(proposed.guesses)


def test_names_that_yaml_reads_otherwise_are_quoted(tmp_path):
    names = ("yes", "1", "a: b", 'say "x"', "Ä#1", "{t}")
    path, _ = written(tmp_path, replace(swing(), names=names), "001: no#t.csv")
    scene, _ = valid(path)
    (recording,) = scene.recordings.values()
    assert tuple(recording.measurement.rest) == names
    assert recording.file == "001: no#t.csv"


def test_many_markers_fit_into_fifty_lines(tmp_path):
    recording, n = swing(), 40
    share = np.linspace(0, 1, n)[:, None]
    x = (1 - share) * recording.positions[:, [0]] + share * recording.positions[:, [4]]
    x[:, ::2, 2] += 0.02
    names = tuple(f"a marker with a long name, number {k}" for k in range(n))
    path, _ = written(tmp_path, Recording(recording.time, names, x, "made"))
    assert len(valid(path)[0].recordings["swing"].measurement.rest) == 8


def test_the_file_is_named_from_the_scene_on(tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "scenes").mkdir()
    write_csv(swing(), tmp_path / "data" / "swing.csv")
    scene = tmp_path / "scenes" / "fit.yaml"
    scene.write_text(fit_scene(tmp_path / "data" / "swing.csv", scene).text)
    assert valid(scene)[0].recordings["swing"].file == "../data/swing.csv"


def test_a_body_in_another_size_has_other_cells():
    small, large = (propose(look(scaled(factor))) for factor in (0.1, 10.0))
    assert large.dx == pytest.approx(100 * small.dx, rel=0.3)
    assert len(small.places) == len(large.places) == 6


def scaled(factor: float) -> Recording:
    """Return a recording of a body that is so many times as large."""
    recording = swing(noise=0.0)
    return replace(recording, positions=factor * recording.positions)


# --- what a user has measured -----------------------------------------------------------------------------------


def test_what_is_given_is_used_and_is_no_guess(tmp_path):
    corner, size = [0.17, -0.318, 0.497], [0.144, 0.036, 0.036]
    path, guesses = written(tmp_path, swing(degrees=4.0), given=Given(size, corner, 0.03, 1200.0))
    scene, lines = valid(path)
    recording, box = scene.recordings["swing"], scene.bodies["body"].shape.value
    assert box.size == size
    assert scene.bodies["body"].material.density == 1200
    shift = np.array(box.corner) - corner
    clamp = scene.boundaries["clamp"].value.region.value
    assert clamp.size[0] == pytest.approx(box.corner[0] + 0.03)
    assert "turned" not in path.read_text()  # the corner is in the axes of the file
    base = look(swing(degrees=4.0)).rest[0]
    assert recording.measurement.rest["base_1"] == pytest.approx(base + shift, abs=1e-4)
    assert not any(word in guesses for word in ("the body is a box", "held up to", "kg/m^3"))
    assert any("across its thinnest part, 0.036 m" in line for line in lines)


def test_cells_of_a_measured_body_hold_whole_particles(tmp_path):
    size = np.array([0.12, 0.035, 0.02])
    path, _ = written(tmp_path, swing(), given=Given(size.tolist()))
    particles = size / (load_scene(path).world.dx / 2)
    np.testing.assert_allclose(particles, np.round(particles), atol=1e-6)


def test_the_axes_of_the_file_are_kept_where_they_can_be(tmp_path):
    recording = swing(release=0.0, duration=0.6)
    recording = replace(recording, positions=np.add(recording.positions, [-0.1, 0.4, -0.35]))
    path, _ = written(tmp_path, recording, given=Given([0.12, 0.02, 0.02], [0.08, 0.09, 0.14], 0.02))
    scene, _ = valid(path)
    assert scene.bodies["body"].shape.value.corner == [0.08, 0.09, 0.14]
    assert "offset:" not in path.read_text()


def test_one_marker_is_enough_for_a_measured_body(tmp_path):
    recording = swing().select(["tip_1"])
    with pytest.raises(DataError, match="or give the edges of the body with --size"):
        fit_scene_of(tmp_path, recording, NOTHING)
    path, guesses = written(tmp_path, recording, given=Given([0.12, 0.04, 0.02], [0.19, -0.32, 0.49]))
    scene, _ = valid(path)
    assert "far from its only marker" in guesses
    low, high = scene.unknowns["bodies.body.material.elastic.fixed_corotated.youngs_modulus"].bounds
    assert high / low == pytest.approx(25, rel=0.1)


def test_a_stiffness_has_wider_bounds_if_the_size_is_a_guess(tmp_path):
    path, _ = written(tmp_path, swing())
    low, high = load_scene(path).unknowns["bodies.body.material.elastic.fixed_corotated.youngs_modulus"].bounds
    assert high / low == pytest.approx(2500, rel=0.1)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (Given([0.1, 0.02]), "--size has 2 numbers, but the recording has 3 axes"),
        (Given(corner=[0.1]), "--corner has 1 numbers, but the recording has 3 axes"),
        (Given([0.1, 0.02, 0.0]), "--size: takes numbers above 0, lengths in m"),
        (Given(density=float("nan")), "--density: takes numbers above 0"),
        (Given(density=1.07), "--density 1.07: no soft robot is so light or heavy; give it in kg/m\\^3"),
        (
            Given([0.02, 0.02, 0.12]),
            "marker 'base_.' would be .* mm outside the body: give edges and corner in the order",
        ),
        (
            Given([100, 20, 20]),
            "--size: the body would be 100 m long, and its markers are 0.1 m apart; give edges in m",
        ),
        (Given([0.1, 0.02, 0.02], clamp=0.1), "--clamp 0.1: nothing of a body of 0.1 m would be free"),
    ],
)
def test_numbers_that_do_not_fit_are_refused(tmp_path, given, message):
    with pytest.raises(UsageError, match=message):
        fit_scene_of(tmp_path, swing(), given)


def fit_scene_of(folder: Path, recording: Recording, given: Given) -> None:
    write_csv(recording, folder / "swing.csv")
    fit_scene(folder / "swing.csv", folder / "fit.yaml", given=given)


@pytest.mark.skipif(not REAL.is_dir(), reason=f"there are no recordings in {REAL}")
@pytest.mark.parametrize(
    ("name", "start", "sag"), [("beam_gravity_V2_a", 0.710, 6.4), ("beam_load101_V2_a", 0.521, 26)]
)
def test_the_scene_of_a_real_recording(tmp_path, name, start, sag):
    path = tmp_path / "real.yaml"
    proposed = fit_scene(REAL / f"{name}.c3d", path)
    path.write_text(proposed.text)
    scene, _ = valid(path)
    (recording,) = scene.recordings.values()
    assert recording.start == pytest.approx(start, abs=0.02)
    assert scene.world.gravity == [-9.81, 0.0, 0.0]
    assert f"by {sag} mm" in " ".join(proposed.guesses)
    assert "Base - 1, Base - 2, Base - 3" in " ".join(proposed.guesses)


@needs_jit
def test_the_scene_of_a_simulated_recording_finds_its_material(tmp_path):
    markers = {"root": [0.04, 0.065], "middle": [0.08, 0.06], "tip": [0.12, 0.065], "low": [0.12, 0.06]}
    overrides = ["bodies.beam.shape.box.size=[0.1, 0.02]", "time.duration=0.6"]
    write_twin(tmp_path / "twin.csv", overrides, start=0.3, markers=markers)
    path = tmp_path / "fit.yaml"
    path.write_text(fit_scene(tmp_path / "twin.csv", path).text)
    low, high = load_scene(path).unknowns["data.recordings.twin.start"].bounds
    assert low < 0.3 < high
    run = run_sysid(path, ["optimizer.least_squares.max_iterations=4"], tmp_path / "out", threads=1)
    losses = read_history(run / "history.csv")["loss"]
    assert losses[-1] < 0.6 * losses[0]
    found = result_of(run)["unknowns"]["bodies.body.material.elastic.fixed_corotated.youngs_modulus"]["value"]
    assert 2.0e4 < found < 6.0e4  # the box that is guessed is thinner than the beam, which has 3.0e4


def test_rest_positions_of_a_motion_without_a_rest_are_better_than_those_of_its_first_frame(rng):
    time = np.arange(400) / 200.0
    rest = np.array([[0.13, 0.09], [0.09, 0.09], [0.06, 0.09]])
    fall = (np.cos(2 * np.pi * 2.5 * time) - 1.0)[:, None, None] * np.array([[0.0, 0.03], [0.0, 0.01], [0.0, 0.003]])
    x = rest + fall + 1e-4 * rng.normal(size=(400, 3, 2))
    found = look(Recording(time, ("tip", "mid", "root"), x, "made")).rest
    assert np.sqrt(np.mean((found - rest) ** 2)) < 0.8e-4
