"""Two checkouts are compared by what their scenes compute, whatever their modules are called."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
SCENE = """\
time: {control_step: 0.01}
"""
PACKAGE = """\
import numpy as np
from types import SimpleNamespace


class Problem:
    def __init__(self, overrides, threads):
        self.end = float(dict(text.split("=") for text in overrides)["time.duration"])

    def value_and_grad(self, params):
        return self.end, {"a": np.array([3.0, 1.0])}, {}

    params = {}

    def simulate(self, params):
        return SimpleNamespace(x=np.full((4, 2), self.end), v=np.ones((4, 2)))


def load(scene, overrides, threads):
    return Problem(overrides, threads)
"""


@pytest.fixture
def benchmark(monkeypatch):
    """Return the script as a module."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    import compare_checkouts

    return compare_checkouts


@pytest.fixture
def compare(benchmark, capsys):
    """Return a function: two checkouts and more words -> exit code, and what is printed."""

    def run(before: Path, after: Path, *words: str) -> tuple[int, str]:
        pythons = ["--python-before", sys.executable, "--python-after", sys.executable]
        code = benchmark.main([str(before), str(after), *pythons, *words])
        return code, capsys.readouterr().out

    return run


@pytest.fixture
def checkouts(tmp_path):
    """Return two folders, each with the scene `toy` and a package that knows only what the script asks of it."""
    for name in ("before", "after"):
        (tmp_path / name / "scenes").mkdir(parents=True)
        (tmp_path / name / "cqrun").mkdir()
        (tmp_path / name / "scenes" / "toy.yaml").write_text(SCENE)
        (tmp_path / name / "cqrun" / "__init__.py").write_text(PACKAGE)
    return tmp_path / "before", tmp_path / "after"


def edited(checkout: Path, old: str, new: str) -> None:
    """Replace text in the package of a checkout."""
    file = checkout / "cqrun" / "__init__.py"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))


def test_this_checkout_is_identical_with_itself(compare, tmp_path):
    code, out = compare(ROOT, ROOT, "--only", "finger", "--out", str(tmp_path / "found.json"))
    assert code == 0, out
    assert out.splitlines()[-1] == "1 scenes: 1 identical, 0 within 1e-12, 0 different or failed"
    assert "the gradient is zero" not in out
    (row,) = json.loads((tmp_path / "found.json").read_text())["scenes"].values()
    assert row["trajectory"] is row["loss"] is row["gradient"] is None
    assert min(row["seconds"]) > 0


def test_toys_are_identical(compare, checkouts):
    code, out = compare(*checkouts)
    assert (code, out.count("identical")) == (0, 4)


@pytest.mark.parametrize(
    ("old", "new", "column", "shown", "code"),
    [
        ("np.ones((4, 2))", "np.ones((4, 2)) * (1 + 1e-9)", "trajectory", "1.0e-09", 1),
        ("return self.end,", "return self.end * (1 + 1e-13),", "loss", "1.0e-13", 0),
        ("[3.0, 1.0]", "[3.0, 1.3]", "gradient", "1.0e-01", 1),
        ("[3.0, 1.0]", "[3.0, np.nan]", "gradient", "inf", 1),
        ("[3.0, 1.0]", "[3.0]", "gradient", "inf", 1),
        ('{"a":', '{"b":', "gradient", "inf", 1),
    ],
)
def test_a_difference_is_found(compare, checkouts, old, new, column, shown, code):
    edited(checkouts[1], old, new)
    found, out = compare(*checkouts)
    header, row = (line.split() for line in out.splitlines()[2:4])
    cells = dict(zip(header, row, strict=False))
    assert (found, cells[column]) == (code, shown)
    assert [cells[other] for other in ("trajectory", "loss", "gradient") if other != column] == ["identical"] * 2


def test_a_scene_that_fails_is_reported(compare, checkouts):
    edited(checkouts[0], "        return self.end,", "        raise ValueError('no loss')\n        return self.end,")
    code, out = compare(*checkouts)
    assert code == 1
    assert "toy                 fails before: ValueError: no loss" in out


def test_a_scene_may_need_other_overrides_in_one_checkout(compare, checkouts):
    assert compare(*checkouts, "--after-override", "toy:time.duration=2")[0] == 1
    edited(checkouts[1], "time.duration", "duration")
    code, out = compare(*checkouts, "--after-override", "toy:duration=0.03")
    assert code == 0, out


def test_scenes_that_cannot_be_compared_are_skipped_with_the_reason(compare, checkouts):
    before, after = checkouts
    (after / "scenes" / "new.yaml").write_text(SCENE)
    for checkout in checkouts:
        (checkout / "scenes" / "recorded.yaml").write_text(SCENE + "data: {recordings: {}}\n")
    code, out = compare(before, after)
    assert code == 0
    assert f"new                 skipped: only {after} has it" in out
    assert "recorded            skipped: it needs the recordings in " in out
    with pytest.raises(SystemExit, match="no scene is called other"):
        compare(before, after, "--only", "other")


def test_every_scene_without_a_loss_is_given_one(benchmark):
    files = benchmark.scenes_of(ROOT)
    assert benchmark.SMALLER.keys() <= files.keys()
    assert set(benchmark.WITHOUT_LOSS) == {name for name, file in files.items() if file.parent.name == "simulate"}
    assert np.isin(benchmark.TWO_THREADS, list(files)).all()
