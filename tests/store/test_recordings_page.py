"""The page docs/recordings.md: every file on it is read, and its scenes use these files."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from cqrun.build.model import build
from cqrun.errors import SceneError
from cqrun.fitting.cases import given_cases
from cqrun.jobs.validate import validate
from cqrun.scene.load import load_scene
from cqrun.store.recordings import read_recording

PAGE = (Path(__file__).parents[2] / "docs" / "recordings.md").read_text()
FILES = dict(re.findall(r"^`([\w.]+)`:\n\n```\w+\n(.*?)^```$", PAGE, re.M | re.S))

MARKERS = ("wide.csv", "semicolons.csv", "long.csv", "motive.csv", "vicon.csv", "qualisys.tsv", "trc.trc")
TABLES = ("poses.csv", "wide_poses.csv", "cell.csv", "pull.csv")

X = np.array(
    [[[0.14, 0.05, 0.12], [0.05, 0.05, 0.12]], [[0.14, 0.05, 0.119], 3 * [np.nan]],
     [[0.141, 0.051, 0.117], [0.05, 0.05, 0.12]]]
)  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    """Return a folder with all files of the page."""
    for name, content in FILES.items():
        (tmp_path / name).write_text(content)
    return tmp_path


def test_every_block_of_the_page_is_a_file_with_a_name():
    assert len(FILES) == PAGE.count("\n```") // 2
    assert set(FILES) == {*MARKERS, *TABLES, "swing.yaml", "arm.yaml"}


@pytest.mark.parametrize("name", MARKERS)
def test_all_files_with_markers_contain_the_same_recording(folder, name):
    recording = read_recording(folder / name)
    assert recording.names == ("arm:tip", "base")
    np.testing.assert_allclose(recording.positions, X, rtol=1e-14)
    np.testing.assert_allclose(recording.time, [0, 0.01, 0.02], rtol=1e-14)


@pytest.mark.parametrize("name", MARKERS)
def test_the_scene_uses_each_file_with_markers(folder, name):
    cases = given_cases(build(load_scene(folder / "swing.yaml", [f"data.recordings.swing.file={name}"])))
    assert [case.name for case in cases or ()] == ["swing"]


def test_a_scene_without_markers_is_told_their_names(folder):
    (folder / "swing.yaml").write_text(re.sub(r"      markers: .*\n", "", FILES["swing.yaml"]))
    with pytest.raises(SceneError, match=r"`markers` is missing: name markers .* it has arm:tip, base"):
        list(validate(folder / "swing.yaml"))


def test_the_scene_uses_all_tables_of_loads(folder):
    assert all(f"file: {name}" in FILES["arm.yaml"] for name in TABLES)
    assert next(iter(validate(folder / "arm.yaml"))) == f"{folder / 'arm.yaml'}: a valid scene"


def test_every_format_has_a_row_in_the_table():
    links = re.findall(r"^\| \[[^\]]+\]\(#([\w-]+)\)", PAGE, re.M)
    titles = [re.sub(r"[^\w-]", "", title.lower().replace(" ", "-")) for title in re.findall(r"^## (.*)$", PAGE, re.M)]
    assert links == [title for title in titles if title in links]
    assert len(links) == 10
