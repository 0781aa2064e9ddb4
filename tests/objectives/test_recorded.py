"""A body that follows a recorded marker: its target positions, and recordings that it cannot follow."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_matter import CONTROL_STEP, N_CONTROLS, made_matter

from cqrun.errors import UsageError
from cqrun.objectives.recorded import RecordedPath
from cqrun.store.recordings import marker_path

TIMES = CONTROL_STEP * np.arange(N_CONTROLS + 1)


@pytest.fixture
def course(tmp_path: Path) -> Callable[..., np.ndarray]:
    """Return a function that gives the target positions for a recording in mm in which a tip is lost for a while."""
    file = tmp_path / "wave.csv"
    lines = [f"{t},{name},{1000 * x},400" for t, x in ((1.0, 0.5), (1.1, 0.6), (1.2, 0.9), (1.3, 0.8))
             for name in ("tip", "root") if not (name == "tip" and t == 1.1)]  # fmt: skip
    file.write_text("\n".join(["time,marker,x,y", *lines, "1.31,root,0,0"]) + "\n")

    def read(dim: int = 2, **fields: Any) -> np.ndarray:
        matter = replace(made_matter(dim), recorded=lambda name, *arguments: marker_path(tmp_path / name, *arguments))
        spec = RecordedPath.model_validate({"file": "wave.csv", "marker": "tip", "units": "mm", "start": 1.0} | fields)
        return spec.course(matter, np.array([0.3, 0.3, 0.3][:dim]))

    return read


def test_path_is_linear_while_the_marker_was_not_seen(course):
    expected = np.interp(TIMES[1:], [0.0, 0.2, 0.3], [0.5, 0.9, 0.8])
    assert course() == pytest.approx(np.stack([expected, np.full(N_CONTROLS, 0.4)], axis=1))


def test_relative_path_starts_at_the_body(course):
    moved = course(relative=True) - course()
    assert moved == pytest.approx(np.broadcast_to([0.3 - 0.5, 0.3 - 0.4], moved.shape))


@pytest.mark.parametrize(
    ("dim", "fields", "words"),
    [
        (2, {"file": "wafe.csv"}, "wafe.csv: there is no such file"),
        (2, {"marker": "top"}, "no marker 'top' (did you mean 'tip'?)"),
        (2, {"start": 1.1}, "wave.csv: marker 'tip' was seen from 1 to 1.3 s; the run needs it from 1.1 to 1.4 s"),
        (2, {"start": 0.0}, "was seen from 1 to 1.3 s; the run needs it from 0 to 0.3 s"),
        (3, {}, "was recorded in 2D, the world has 3 dimensions"),
        (2, {"units": "m"}, "leaves the world after 0 s: x = 500 m, outside 0 to 2 m; `relative: true` follows"),
    ],
)
def test_recordings_that_cannot_be_followed_are_errors(course, dim, fields, words):
    with pytest.raises(UsageError, match=re.escape(words)):
        course(dim, **fields)
