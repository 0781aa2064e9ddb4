"""Errors of bad recordings: exit code 2, which recording, what is wrong, what to do; no run directory remains."""

from __future__ import annotations

import re
from pathlib import Path

import made_c3d
import numpy as np
import pytest
from small_beam import record, recorded

REST = {"a": [0.11, 0.02, 0.03], "b": [0.11, 0.04, 0.03], "c": [0.05, 0.02, 0.03], "d": [0.05, 0.04, 0.03]}
"""Rest positions of the markers of the 3D beam below [m]."""

BEAM_3D = """\
cqrun: 1
world: {size: [0.14, 0.06, 0.06], dx: 0.01, gravity: [0, 0, -9.81], frame: updated}
bodies:
  beam:
    shape: {box: {corner: [0.02, 0.02, 0.02], size: [0.1, 0.03, 0.03]}}
    particles_per_cell: 8
    material: {density: 1000, elastic: {fixed_corotated: {youngs_modulus: 3.0e4, poissons_ratio: 0.3}}}
time: {duration: 0.1, control_step: 0.01}
"""


def markers(chosen: dict[str, list[float]]) -> str:
    return "{" + ", ".join(f"{name}: {place}" for name, place in chosen.items()) + "}"


@pytest.fixture
def positions(rng):
    """Return positions (T, M, 3) [m] at 100 Hz, in the recording's own axes: at rest for 0.1 s, then falling."""
    time = 0.01 * np.arange(31)
    rest = np.array(list(REST.values()))
    fall = np.maximum(time - 0.1, 0.0) ** 2
    moved = rest + fall[:, None, None] * np.array([0.0, 0.0, -1.0]) + 1e-5 * rng.normal(size=(31, 4, 3))
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return moved @ turned.T + [1.0, 2.0, 3.0]


def write_c3d(path: Path, positions: np.ndarray, *, names: tuple[str, ...] = tuple(REST)) -> Path:
    return made_c3d.write_c3d(path, positions, names=names)


def write_csv(path: Path, positions: np.ndarray, names: tuple[str, ...] = tuple(REST)) -> Path:
    lines = ["time,marker,x,y,z"]
    for k, frame in enumerate(positions):
        lines += [f"{k / 100},{name},{','.join(map(repr, x))}" for name, x in zip(names, frame.tolist(), strict=True)]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture
def refused(cqrun, tmp_path):
    """Return a function that runs `cqrun sysid` on a recording and returns the error message."""

    def message(file: Path, rest: dict[str, list[float]] | None = None, **entries: str) -> str:
        spec = {"file": file, "start": "0.1", "still": "[0, 0.09]", "markers": markers(rest or REST), **entries}
        inside = ", ".join(f"{key}: {value}" for key, value in spec.items() if value)
        data = f"data: {{recordings: {{swing: {{{inside}}}}}}}\n"
        scene = tmp_path / "scene.yaml"
        scene.write_text(BEAM_3D + data + "unknowns: {bodies.beam.material.density: {bounds: [500, 2000]}}\n")
        answers = [cqrun(command, scene, *where) for command, *where in (("sysid", "--out", tmp_path), ("validate",))]
        (code, out, err), (code_too, _, err_too) = answers
        assert (code, code_too) == (2, 2), err
        assert out == ""
        assert err == err_too
        assert not (tmp_path / "scene").exists()
        assert re.match(rf"{re.escape(str(scene))}:\d+:\d+: data\.recordings\.swing", err), err
        assert "data.recordings.swing" in err
        return err

    return message


def test_the_unchanged_recording_is_accepted(cqrun, tmp_path, positions):
    """The tests below change one thing each in this recording."""
    scene = tmp_path / "scene.yaml"
    file = write_c3d(tmp_path / "swing.c3d", positions)
    own = f"{{file: {file}, start: 0.1, still: [0, 0.09], markers: {markers(REST)}}}"
    scene.write_text(BEAM_3D + f"data: {{recordings: {{swing: {own}}}}}\n")
    code, out, err = cqrun("validate", scene)
    assert (code, err) == (0, "")
    assert "swing (fitted): 4 markers, 11 frames from 0.1 to 0.2 s" in out
    assert "aligned to the rest positions within 0.00 to 0.0" in out


def test_all_bad_recordings_are_reported_at_once(cqrun, tmp_path, positions):
    """A truncated file and one that is not C3D: one line each, which begins with its place in the scene."""
    cut = write_c3d(tmp_path / "cut.c3d", positions)
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size // 2])
    (tmp_path / "other.c3d").write_text("time,marker,x,y,z\n" * 200)
    own = [f"{name}: {{file: {tmp_path / name}.c3d, start: 0, markers: {markers(REST)}}}" for name in ("cut", "other")]
    scene = tmp_path / "scene.yaml"
    scene.write_text(BEAM_3D + f"data: {{recordings: {{{', '.join(own)}}}}}\n")
    code, _, err = cqrun("validate", scene)
    assert code == 2
    lines = err.splitlines()
    assert [re.match(rf"{re.escape(str(scene))}:\d+:\d+: data\.recordings\.(\w+): ", line)[1] for line in lines] == [
        "cut", "other",
    ]  # fmt: skip
    assert "truncated" in lines[0]
    assert "not a C3D file" in lines[1]


def test_a_missing_file(refused, tmp_path):
    assert "there is no file '" in refused(tmp_path / "none.c3d")


@pytest.mark.parametrize("suffix", [".c3d", ".csv", ".trc", ".h5"])
def test_an_empty_file(refused, tmp_path, suffix):
    (tmp_path / f"empty{suffix}").write_bytes(b"")
    assert "the file is empty" in refused(tmp_path / f"empty{suffix}")


@pytest.mark.parametrize("part", [0.3, 0.6, 0.97])
def test_truncated_c3d(refused, tmp_path, positions, part):
    file = write_c3d(tmp_path / "swing.c3d", positions)
    file.write_bytes(file.read_bytes()[: int(part * file.stat().st_size)])
    assert "truncated" in refused(file)


def test_truncated_csv(refused, tmp_path, positions):
    file = write_csv(tmp_path / "swing.csv", positions)
    file.write_text(file.read_text()[:-30])
    assert "is the file truncated?" in refused(file)


def test_a_file_that_is_not_c3d(refused, tmp_path):
    (tmp_path / "swing.c3d").write_text("time,marker,x,y,z\n" * 200)
    assert "not a C3D file" in refused(tmp_path / "swing.c3d")


def test_another_format(refused, tmp_path):
    (tmp_path / "swing.dat").write_text("x")
    assert "a recording ends in .c3d, .csv, .tsv, .txt, .trc, .h5, not in '.dat'" in refused(tmp_path / "swing.dat")
    (tmp_path / "swing.txt").write_text("something else")
    assert "swing.txt:1: the first line must name the columns: time,marker,x,y,z" in refused(tmp_path / "swing.txt")


def test_millimetres(refused, tmp_path, positions):
    message = refused(write_csv(tmp_path / "swing.csv", 1e3 * positions))
    assert "it looks as if the recording is in millimetres: say `units: mm`" in message


def test_a_marker_that_is_never_seen(refused, tmp_path, positions):
    positions[:, 2] = np.nan
    assert "marker 'c' is NaN in every frame" in refused(write_c3d(tmp_path / "swing.c3d", positions))


def test_a_marker_that_is_not_seen_at_rest(refused, tmp_path, positions):
    positions[:12, 2] = np.nan
    message = refused(write_c3d(tmp_path / "swing.c3d", positions))
    assert "marker 'c' is not seen in any still frame" in message


def test_half_a_position(refused, tmp_path, positions):
    file = write_csv(tmp_path / "swing.csv", positions)
    lines = file.read_text().splitlines()
    lines[6] = "0.01,b,1.0,nan,3.0"
    file.write_text("\n".join(lines))
    assert "some coordinates of marker 'b' are nan and some are not" in refused(file)


def test_an_unknown_marker(refused, tmp_path, positions):
    file = write_c3d(tmp_path / "swing.c3d", positions, names=("a", "b", "c", "tip"))
    assert "no marker 'd'; it has 'a', 'b', 'c', 'tip'" in refused(file)


def test_a_repeated_marker(refused, tmp_path, positions):
    file = write_c3d(tmp_path / "swing.c3d", positions, names=("a", "b", "c", "c"))
    assert "marker 'c' appears 2 times" in refused(file, {k: REST[k] for k in "abc"})


def test_a_marker_twice_at_one_time(refused, tmp_path, positions):
    file = write_csv(tmp_path / "swing.csv", positions)
    lines = file.read_text().splitlines()
    file.write_text("\n".join([*lines[:5], lines[4], *lines[5:]]))
    assert "marker 'd' appears twice at time 0 s" in refused(file)


def test_time_that_goes_back(refused, tmp_path, positions):
    file = write_csv(tmp_path / "swing.csv", positions)
    lines = file.read_text().splitlines()
    file.write_text("\n".join([*lines[:9], *lines[13:17], *lines[9:13]]))
    assert "time does not increase: marker 'a' goes from 0.03 s back to 0.02 s" in refused(file)


@pytest.mark.parametrize(("start", "window"), [("0.25", "0.25 to 0.35"), ("-0.05", "-0.05 to 0.05")])
def test_a_window_outside(refused, tmp_path, positions, start, window):
    message = refused(write_c3d(tmp_path / "swing.c3d", positions), start=start)
    assert f"the window, {window} s (start + length), does not lie inside the recording, 0 to 0.3 s" in message


def test_still_frames_outside(refused, tmp_path, positions):
    message = refused(write_c3d(tmp_path / "swing.c3d", positions), still="[0.2, 0.4]")
    assert "the still frames, 0.2 to 0.4 s, do not lie inside the recording, 0 to 0.3 s" in message


@pytest.mark.parametrize("still", ["[0, 0.15]", "[0.11, 0.2]"])
def test_still_frames_in_the_motion(refused, tmp_path, positions, still):
    message = refused(write_c3d(tmp_path / "swing.c3d", positions), still=still)
    assert f"the still frames, {still[1:-1].replace(',', ' to')} s, overlap with 0.1 to 0.2 s" in message
    assert "end `still` at 0.1 s at the latest" in message


@pytest.mark.parametrize(("earliest", "code"), [(0.09, 0), (0.085, 2)])
def test_still_frames_after_the_earliest_start(cqrun, tmp_path, positions, earliest, code):
    write_csv(tmp_path / "swing.csv", positions)
    scene = tmp_path / "scene.yaml"
    swing = f"{{file: swing.csv, start: 0.1, still: [0, 0.09], markers: {markers(REST)}}}"
    unknowns = f"unknowns: {{data.recordings.swing.start: {{bounds: [{earliest}, 0.11]}}}}\n"
    scene.write_text(f"{BEAM_3D}data: {{recordings: {{swing: {swing}}}}}\n{unknowns}")
    actual, _, err = cqrun("validate", scene)
    assert actual == code
    assert code == 0 or "end `still` at 0.085 s at the latest, the earliest possible `start`" in err


def test_fewer_than_three_markers(refused, tmp_path, positions):
    message = refused(write_c3d(tmp_path / "swing.c3d", positions), {k: REST[k] for k in "ab"})
    assert "2 alignment markers; a rigid alignment in 3D needs 3 or more" in message


def test_markers_on_one_line(refused, tmp_path, positions):
    rest = {"a": [0.11, 0.02, 0.03], "b": [0.08, 0.02, 0.03], "c": [0.05, 0.02, 0.03]}
    message = refused(write_c3d(tmp_path / "swing.c3d", positions), rest)
    assert "the rest positions of the markers lie on one line" in message


def test_a_residual_too_large_for_the_extent_of_the_markers(refused, tmp_path, positions):
    rest = {**REST, "a": [0.11, 0.035, 0.03]}
    message = refused(write_c3d(tmp_path / "swing.c3d", positions), rest)
    assert "mm from its rest position, more than 3.2 mm, 5% of the markers' extent, (all, mm: 'a' " in message
    assert "whether two names are swapped" in message


@pytest.mark.parametrize("named", [None, {}], ids=["absent", "empty"])
def test_no_markers(refused, tmp_path, positions, named):
    file = write_csv(tmp_path / "swing.csv", positions)
    message = refused(file, None, markers="" if named is None else "{}", still="")
    assert "`markers` is missing: name markers of the recording and where each is at rest" in message
    assert "such as a: [x, y, z]; it has a, b, c, d" in message


def test_positions_far_from_the_body(refused, tmp_path, positions):
    file = write_csv(tmp_path / "swing.csv", positions)
    message = refused(file, still="")
    assert re.search(r"marker 'a' is never nearer than [\d.]+ m to where it is at rest, and the body is", message)
    assert "without `still` frames positions are in the scene's own frame" in message


def test_positions_in_millimetres(refused, tmp_path):
    rest = np.tile(list(REST.values()), (31, 1, 1))
    message = refused(write_csv(tmp_path / "swing.csv", 1e3 * rest), still="")
    assert "m across: the file looks as if it is in mm: say `units: mm`" in message


def test_times_that_are_not_in_seconds(refused, tmp_path):
    rest = np.tile(list(REST.values()), (31, 1, 1))
    file = write_csv(tmp_path / "swing.csv", rest)
    lines = [line.split(",", 1) for line in file.read_text().splitlines()]
    file.write_text("\n".join([",".join(lines[0]), *(f"{100 * float(t):.0f},{x}" for t, x in lines[1:])]))
    message = refused(file, still="", start="0")
    words = "only one frame lies between 0 and 0.1 s, which are compared; 2 or more must: times are in seconds"
    assert words in message
    assert "the recording's run from 0 to 30" in message


def test_a_length_between_control_steps(refused, tmp_path, positions):
    message = refused(write_csv(tmp_path / "swing.csv", positions), length="0.033")
    assert "`length`, 0.033 s, is not a multiple of the control step 0.01 s; the nearest is 0.03 s" in message


def test_a_start_that_leaves_nothing_to_compare(cqrun, tmp_path, positions):
    write_csv(tmp_path / "swing.csv", positions)
    scene = tmp_path / "scene.yaml"
    swing = f"{{file: swing.csv, start: 0.1, still: [0, 0.09], markers: {markers(REST)}}}"
    unknowns = "unknowns: {data.recordings.swing.start: {bounds: [0, 0.2]}}\n"
    scene.write_text(f"{BEAM_3D}data: {{recordings: {{swing: {swing}}}}}\n{unknowns}")
    code, _, err = cqrun("validate", scene)
    assert code == 2
    assert "the start may be anywhere from 0 to 0.2 s, but only 0.1 s after it are compared" in err


def test_a_recording_that_changes_under_a_run(cqrun, tmp_path):
    """A changed recording makes another run, and the old run reports the change."""
    (file,) = record(tmp_path / "fit.yaml", tmp_path / "data")
    scene = recorded(tmp_path / "fit.yaml", {"one": file})
    words = ("-o", "optimizer.least_squares.max_iterations=1", "--out", tmp_path / "out", "--quiet")
    assert cqrun("sysid", scene, *words)[0] == 0
    (run,) = (tmp_path / "out").glob("*/*")
    file.write_text(file.read_text().replace("0.05,tip,", "0.05,tip ,"))
    more = ("-o", "optimizer.least_squares.max_iterations=2")
    code, _, err = cqrun("resume", run, *more)
    assert code == 2
    assert "a recording that it names has changed since the run began; run the scene again" in err
    file.unlink()
    code, _, err = cqrun("resume", run, *more)
    assert code == 2
    assert f"there is no file '{file}'" in err


def test_a_name_that_no_file_can_have(cqrun, tmp_path):
    scene = recorded(tmp_path / "fit.yaml", {"one": "a" * 5000})
    code, _, err = cqrun("sysid", scene, "--out", tmp_path)
    assert code == 2
    assert "data.recordings.one.file: there is no file" in err


def test_all_missing_recordings_are_reported_at_once(cqrun, tmp_path):
    scene = recorded(tmp_path / "fit.yaml", {"one": tmp_path / "1.c3d", "two": tmp_path / "2.c3d"})
    code, _, err = cqrun("sysid", scene, "--out", tmp_path)
    assert code == 2
    thin, *lines = err.splitlines()
    assert "bodies.beam.shape: is 1 cell thick" in thin
    assert [line.partition(": ")[2].partition(":")[0] for line in lines] == [
        f"data.recordings.{name}.file" for name in ("one", "two")
    ]
    assert all("-o data.recordings." in line for line in lines)  # and how to name another file
