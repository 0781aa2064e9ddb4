"""Recordings with errors of cameras: what a fit makes of them, and what it says."""

from __future__ import annotations

import re

import pytest
from small_beam import E_PATH, Listener, record, recorded, result_of

from cqrun.errors import SceneError
from cqrun.jobs.sysid import run_sysid
from cqrun.jobs.validate import validate

LOST = re.compile(r"(0\.0[456],tip),.*")
SAID = "one: marker 'tip' is at exactly 0 in frames 4 to 6 (0.04 to 0.06 s): taken as not seen"


@pytest.fixture
def lines(fit, tmp_path):
    """Return the lines of a recording in which one marker is lost for three frames, when it was seen."""
    (file,) = record(fit, tmp_path / "data")
    return file.read_text().splitlines()


@pytest.fixture
def scene(tmp_path):
    """Return a function that writes a scene with a recording of some lines."""

    def write(name, lines):
        (tmp_path / f"{name}.csv").write_text("\n".join(lines) + "\n")
        return recorded(tmp_path / f"{name}.yaml", {"one": tmp_path / f"{name}.csv"})

    return write


def test_gaps_that_are_written_as_zeros_are_gaps(scene, lines, tmp_path):
    zeros = scene("zeros", [LOST.sub(r"\1,0,0", line) for line in lines])
    gaps = scene("gaps", [line for line in lines if not LOST.match(line)])
    listener = Listener()
    found, expected = (
        result_of(run_sysid(path, [], tmp_path / path.stem, threads=1, reporter=listener)) for path in (zeros, gaps)
    )
    assert found["unknowns"][E_PATH] == expected["unknowns"][E_PATH]
    assert found["recordings"] == expected["recordings"]
    assert listener.said.count(f"warning: {SAID}") == 1
    assert f"warning: {SAID}" in list(validate(zeros))


def test_a_marker_at_zero_in_every_frame(scene, lines):
    path = scene("zeros", [re.sub(r"(.*,tip),.*", r"\1,0,0", line) for line in lines])
    with pytest.raises(SceneError, match="marker 'tip' is at exactly 0 in every frame: it was not seen; leave it out"):
        list(validate(path))


def test_a_leap_that_stays_is_refused_at_the_recording(scene, lines):
    path = scene("leap", [re.sub(r"(0\.0[789]|0\.1),tip,0", r"\1,tip,1", line) for line in lines])
    with pytest.raises(SceneError, match=r"data\.recordings\.one: .*: marker 'tip' leaps by .* m between frames"):
        list(validate(path))
