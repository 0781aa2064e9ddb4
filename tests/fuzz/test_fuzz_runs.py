"""Whatever is damaged in a run, a command goes on to the same result or says which file is at fault."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from corruptions import damage
from harness import judged
from small_beam import BEAM, FIT, Listener, contents, recorded
from small_finger import DESIGN, written

from cqrun.errors import Stopped
from cqrun.jobs.control import run_codesign, run_control
from cqrun.jobs.gradcheck import run_gradcheck
from cqrun.jobs.simulate import run_simulate
from cqrun.jobs.sysid import run_sysid

SEED = 45

FEW = 40
"""Number of damaged runs in the short test."""

MANY, CHUNK = 500, 50
"""Number of damaged runs in the long test, and in one test of it."""

DRAWN, REPLAYED = ("resume", "plot", "render --png", "report"), ("resume", "plot", "render --png", "report", "simulate")
LEARNING, FITTING = ("resume", "resume", "plot", "simulate"), ("resume", "resume", "plot")

UNREAD = {"scene.original.yaml"}
"""Files that are kept for people and that no command reads."""

Runs = dict[str, tuple[Path, Path | None, tuple[str, ...]]]
"""Runs by name; beside one that was stopped, the same run that was not; and what a user may do with it."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Runs:
    """Return runs of every job."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "fit.yaml").write_text(BEAM + FIT)
    finger, design = written(folder), folder / "design.yaml"
    design.write_text(DESIGN)
    adam = ["optimizer={adam: {max_iterations: 6}}"]
    found: Runs = {}
    for name, job, scene, overrides in (
        ("sysid", run_sysid, folder / "fit.yaml", adam),
        ("sysid by least squares", run_sysid, folder / "fit.yaml", ["optimizer.least_squares.max_iterations=3"]),
        ("control", run_control, finger, adam),
        ("codesign", run_codesign, design, ["constraints.tip.at_most=0.03"]),
    ):
        whole = job(scene, overrides, folder / "whole" / name, threads=1)
        with pytest.raises(Stopped):
            job(scene, overrides, folder / "half" / name, threads=1, reporter=Listener(stop_after=3))
        (half,) = (folder / "half" / name).glob("*/*")
        found[name] = half, whole, FITTING if job is run_sysid else LEARNING
        found[f"{name}, finished"] = whole, None, REPLAYED
    data = sorted((found["sysid"][1] / "synthetic").glob("*.csv"))[0]
    recording = recorded(folder / "recorded.yaml", {"swing": data})
    found["sysid of a recording, finished"] = run_sysid(recording, adam, folder / "out", threads=1), None, REPLAYED
    plain = ["unknowns={}", "data=null"]
    found["simulate, finished"] = run_simulate(folder / "fit.yaml", plain, folder / "out", threads=1), None, DRAWN
    found["replay, finished"] = run_simulate(found["control"][1], [], folder / "out", threads=1), None, DRAWN
    found["gradcheck"] = run_gradcheck(folder / "fit.yaml", [], folder / "out", threads=1)[0], None, ("resume",)
    return found


@dataclass(frozen=True)
class Case:
    """A damaged run, and a command on it.

    Attributes:
        what: all that tells it apart, for messages.
        run: the damaged copy.
        whole: the same run, undamaged and never stopped, if it was stopped.
        file: the damaged file.
        words: of the command.
    """

    what: str
    run: Path
    whole: Path | None
    file: Path
    words: list[str]


def cases(runs: Runs, folder: Path, seeds: range) -> Iterator[Case]:
    """Yield a damaged run for each seed; the copies are in a folder."""
    for seed in seeds:
        rng = np.random.default_rng([SEED, seed])
        name = sorted(runs)[rng.integers(len(runs))]
        run, whole, commands = runs[name]
        copy = folder / str(seed) / run.parent.name / run.name
        shutil.copytree(run, copy)
        file, how = damage(copy, rng)
        words = commands[rng.integers(len(commands))].split()
        words.insert(1, str(copy))
        words += ["--out", str(folder / str(seed) / "out")] if words[0] == "simulate" else []
        yield Case(f"{seed}: {name}: {file.name} {how}: {words[0]}", copy, whole, file, words)


def fault(case: Case, code: int | None, said: str) -> str:
    """Return what is wrong with how a command took a damaged run, or an empty text."""
    if code not in (0, 1, 2):
        return f"ended with {code}: {said}"
    if code and case.file.name == "run.json":  # what it says of other files is then wrong
        return "" if case.run.name in said else f"does not name the run: {said}"
    if code:
        return "" if case.file.name.split(".")[0] in said else f"does not name the file: {said}"
    if case.whole is not None and case.words[0] == "resume":
        mine, theirs = contents(case.run), contents(case.whole)
        different = [name for name in mine.keys() | theirs.keys() if mine.get(name) != theirs.get(name)]
        if set(different) - UNREAD:
            return f"went on to other {different}"
    return ""


def faults(runs: Runs, folder: Path, seeds: range) -> list[str]:
    """Return what is wrong with how commands take damaged runs; nothing outside the damaged ones may change."""
    damaged, before = list(cases(runs, folder, seeds)), _stamps(runs)
    found = []
    answers = judged("judge_commands.py", [json.dumps(case.words) for case in damaged])
    for case, (_, answer) in zip(damaged, answers, strict=True):
        code, said = (None, answer) if isinstance(answer, str) else answer
        if wrong := fault(case, code, said):
            found.append(f"{case.what}: {wrong}")
    assert _stamps(runs) == before
    return found


def _stamps(runs: Runs) -> list[tuple[str, int, int]]:
    files = [path for run, _, _ in runs.values() for path in sorted(run.rglob("*"))]
    return [(str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in files]


def test_damaged_runs_go_on_to_the_same_result_or_are_refused_by_name(runs: Runs, tmp_path) -> None:
    found = faults(runs, tmp_path, range(FEW))
    assert not found, "\n".join(found)


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, MANY, CHUNK))
def test_many_damaged_runs_go_on_to_the_same_result_or_are_refused_by_name(runs: Runs, tmp_path, first: int) -> None:
    found = faults(runs, tmp_path, range(first, first + CHUNK))
    assert not found, "\n".join(found)
