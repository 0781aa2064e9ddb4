"""A user's actuators, observers, controllers, objectives and optimizers, made by renaming copies of cqrun's."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from little_worlds import needs_jit
from plugin_sandbox import sandbox
from small_finger import written

from cqrun.store.history import read_history

CQRUN = Path(__file__).parents[2] / "cqrun"
COPIED = {
    "actuator": ("actuators", "muscle"),
    "observer": ("observers", "clock"),
    "controller": ("controllers", "linear_tanh"),
    "objective": ("objectives", "effort"),
    "optimizer": ("optimizers", "adam"),
}

pytestmark = needs_jit


@pytest.fixture(autouse=True)
def _sandbox() -> Iterator[None]:
    with sandbox():
        yield


def history_of(cqrun, scene: Path, *words: str) -> dict[str, np.ndarray]:
    """Return the history of a run of the scene."""
    out = scene.parent / "out"
    code, printed, err = cqrun("control", scene, "--quiet", "--threads", "1", "--out", out, *words)
    assert code == 0, err
    history = read_history(Path(re.search(r"^run: (.*)$", printed, re.M).group(1)) / "history.csv")
    return {name: np.array(column) for name, column in history.items() if name != "seconds"}


def test_copies_give_the_same_results_as_the_built_in_plug_ins(cqrun, tmp_path):
    (tmp_path / "theirs").mkdir()
    theirs = history_of(cqrun, written(tmp_path / "theirs"))
    scene = written(tmp_path)
    text = scene.read_text()
    for kind, (folder, name) in COPIED.items():
        source = (CQRUN / folder / f"{name}.py").read_text()
        ours, count = re.subn(rf'@plugin\("{kind}", "{name}"\)', f'@plugin("{kind}", "own_{name}")', source)
        assert count == 1
        (tmp_path / f"own_{name}.py").write_text(ours)
        text, count = re.subn(rf"\{{{name}: \{{", f"{{own_{name}: {{", text)
        assert count == 1
    files = ", ".join(f"own_{name}.py" for _, name in COPIED.values())
    scene.write_text(text.replace("job: control", f"plugins: [{files}]\njob: control"))
    ours = history_of(cqrun, scene, "--allow-plugins")
    assert list(ours) == list(theirs)
    for name, column in theirs.items():
        np.testing.assert_allclose(ours[name], column, rtol=1e-9, atol=1e-12)
