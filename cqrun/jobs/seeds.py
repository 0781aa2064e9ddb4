"""`cqrun control --seeds N`: one scene learned from several seeds side by side, and what they have in common.

Every seed is a run of its own, in a process of its own, that can be stopped and resumed as any other; the same
command again continues those that are not finished. What they found is summed up beside their directories:

summary-<hash>.json   of every seed and of all: mean and 90 % interval (Student) of the loss and of every term
summary-<hash>.csv    the same as a table

The hash is that of the scene without its seed.
"""

from __future__ import annotations

import csv
import io
import json
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np

from cqrun.errors import UsageError
from cqrun.jobs.control import optimizer_of, prepare
from cqrun.jobs.kernels import compile_kernels
from cqrun.jobs.report import number, table
from cqrun.jobs.reporter import EXIT_INTERRUPTED, Reporter, Silent
from cqrun.jobs.runs import cores, run_scene
from cqrun.objectives.uncertainty import interval_of_mean
from cqrun.scene.load import dump, load_scene, resolve
from cqrun.scene.paths import with_values
from cqrun.scene.schema import Scene
from cqrun.store.atomic import make_directory, write_json, write_text
from cqrun.store.run import RunScene

CONFIDENCE = 0.9
"""Of the intervals of means."""

EVERY = 0.2
"""Time between two looks at the processes [s]."""

STAGES = {"start": "before", "trained": "learned", "unseen": "on unseen goals"}
"""Parts of a control run's result, and what they are called."""


@dataclass
class Seed:
    """One seed's run: its directory, how it failed if it did, and its process while there is one."""

    seed: int
    run: Path
    failure: str | None = None
    process: subprocess.Popen[bytes] | None = None
    said: IO[bytes] | None = None

    @property
    def iteration(self) -> int:
        """How many iterations its history has."""
        history = self.run / "history.csv"
        return max(0, history.read_bytes().count(b"\n") - 2) if history.is_file() else 0

    def start(self, command: Sequence[str]) -> None:
        """Begin; out of reach of the terminal's Ctrl-C, which this process hands on once."""
        self.said = tempfile.TemporaryFile()  # noqa: SIM115  closed when the process is over
        self.process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=self.said, start_new_session=True
        )

    def ask(self, number: signal.Signals) -> None:
        """Ask it to stop at the next iteration."""
        if self.process is not None:
            self.process.send_signal(number)

    def ended(self) -> bool:
        """Say whether its process is over; a failure is known then."""
        return self.process is not None and self.process.poll() is not None and self._take_leave()

    def kill(self) -> None:
        """End it where it stands: it can be resumed from its last checkpoint."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self._take_leave()

    def _take_leave(self) -> bool:
        assert self.process is not None
        assert self.said is not None
        if self.process.returncode != 0:
            self.said.seek(0)
            lines = self.said.read().decode(errors="replace").strip().splitlines()
            self.failure = lines[-1].removeprefix("error: ") if lines else f"ended with {self.process.returncode}"
        self.said.close()
        self.process = self.said = None
        return True


def run_seeds(
    source: Path,
    overrides: Sequence[str],
    out: Path,
    fresh: bool,
    threads: int | None,
    *,
    seeds: int,
    jobs: int | None = None,
    allow_plugins: bool = False,
    reporter: Reporter | None = None,
) -> tuple[Path, bool]:
    """Learn a scene's controller from seeds 0 .. seeds - 1; return the summary's file and whether all went well.

    Args:
        seeds: how many.
        jobs: how many processes at once; as many as there are threads if absent.
        threads: all together; every process has an equal share.
        allow_plugins: handed on.

    Raises:
        SceneError, UsageError: bad input. Stopped: asked to stop; the same command goes on.
    """
    talk, n_threads = reporter or Silent(), cores(threads)
    _require(overrides, seeds, jobs)
    at_once = min(seeds, n_threads if jobs is None else jobs)
    problem = prepare(load_scene(source, overrides), 1, talk)
    scene, optimizer = problem.built.scene, optimizer_of(problem.built)
    compile_kernels([problem.built], talk, adjoint=optimizer.gradients)
    all_of_them = [Seed(k, _directory(source, scene, k, out)) for k in range(seeds)]
    command = [sys.executable, "-m", "cqrun", "control", str(source), "--quiet", "--out", str(out)]
    command += ["--threads", str(max(1, n_threads // at_once))]
    command += ["--fresh"] * fresh + ["--allow-plugins"] * allow_plugins
    command += [word for override in overrides for word in ("-o", override)]
    talk.phase(f"learning from {seeds} seeds, {at_once} at once")
    _run_all(all_of_them, command, at_once, optimizer.max_iterations, talk)
    good = [s for s in all_of_them if s.failure is None]
    if talk.stop.asked and len(good) < seeds:
        raise talk.stop.stopped(f"{len(good)} of {seeds} seeds are finished; the same command continues the others")
    path = out / source.stem / f"summary-{_inputs(source, scene, None).digest()}.json"
    summary = _summary(source.stem, all_of_them)
    make_directory(path.parent)
    write_json(path, summary)
    write_text(path.with_suffix(".csv"), _table(summary))
    return path, len(good) == seeds


def _require(overrides: Sequence[str], seeds: int, jobs: int | None) -> None:
    for name, count in (("seeds", seeds), ("jobs", jobs)):
        if count is not None and count < 1:
            raise UsageError(f"--{name} {count}: must be at least 1; without it the scene is learned from its own seed")
    for override in overrides:
        if override.partition("=")[0].strip() == "seed":
            raise UsageError(f"-o {override}: --seeds gives every run a seed of its own: remove one of the two")


def _inputs(source: Path, scene: Scene, seed: int | None) -> RunScene:
    """Return what names the run of a seed, or of none in particular."""
    if seed is not None:
        return run_scene(source.stem, with_values(scene, {"seed": seed}), job="control", with_data=False)
    unseeded = {key: value for key, value in resolve(scene).items() if key != "seed"}
    return replace(run_scene(source.stem, scene, job="control", with_data=False), resolved=dump(unseeded))


def _directory(source: Path, scene: Scene, seed: int, out: Path) -> Path:
    return out / source.stem / _inputs(source, scene, seed).digest()


# --- processes ----------------------------------------------------------------------------------------------------


def _run_all(seeds: Sequence[Seed], command: Sequence[str], at_once: int, iterations: int, talk: Reporter) -> None:
    """Run every seed's process; a first request to stop is handed on, and none begins after it."""
    waiting, running, asked = list(seeds), list[Seed](), False
    try:
        while waiting or running:
            if talk.stop.asked and not asked:
                asked = True
                for seed in waiting:
                    seed.failure = "not begun"
                waiting.clear()
                for seed in running:
                    seed.ask(signal.SIGINT if talk.stop.exit_code == EXIT_INTERRUPTED else signal.SIGTERM)
            while waiting and len(running) < at_once:
                running.append(waiting.pop(0))
                running[-1].start([*command, "-o", f"seed={running[-1].seed}"])
            for seed in [s for s in running if s.ended()]:
                running.remove(seed)
                if seed.failure is not None and not asked:
                    talk.warn(f"seed {seed.seed}: {seed.failure}")
            if not asked:
                _tell(seeds, running, waiting, iterations, talk)
            if running:
                time.sleep(EVERY)
    finally:  # after a second Ctrl-C, or an error here
        for seed in running:
            seed.kill()


def _tell(
    seeds: Sequence[Seed], running: Sequence[Seed], waiting: Sequence[Seed], iterations: int, talk: Reporter
) -> None:
    """Report one line for all."""
    over = len(seeds) - len(running) - len(waiting)
    reached = [f"seed {s.seed} at {s.iteration}/{iterations}" for s in running]
    done = iterations * over + sum(s.iteration for s in running)
    talk.advance(done, iterations * len(seeds), ", ".join([f"{over} of {len(seeds)} seeds", *reached]))


# --- what they have in common -------------------------------------------------------------------------------------


def interval(values: Sequence[float]) -> dict[str, float | None]:
    """Return the mean of values and its 90 % interval by Student's distribution, which one value alone has not."""
    x = np.array(values, float)
    if len(x) == 1:
        return {"mean": float(x[0]), "low": None, "high": None}
    mean, half = map(float, interval_of_mean(x, CONFIDENCE))
    return {"mean": mean, "low": mean - half, "high": mean + half}


def _summary(stem: str, seeds: Sequence[Seed]) -> dict[str, Any]:
    """Return what every seed found, and means with intervals over those that went well."""
    results = {s.seed: json.loads((s.run / "result.json").read_text()) for s in seeds if s.failure is None}
    found = list(results.values())
    stages = [stage for stage in STAGES if found and all(result[stage] is not None for result in found)]
    return {
        "scene": stem,
        "confidence": CONFIDENCE,
        "seeds": {
            s.seed: {"run": str(s.run), "status": "failed", "reason": s.failure}
            if s.failure is not None
            else {"run": str(s.run)} | {key: results[s.seed][key] for key in ("status", "iterations")}
            | {stage: _numbers(results[s.seed][stage]) for stage in stages}
            for s in seeds
        },
        "all": {
            stage: {
                name: interval([_numbers(result[stage])[name] for result in found])
                for name in _numbers(found[0][stage])
            }
            for stage in stages
        },
    }  # fmt: skip


def _numbers(stage: Mapping[str, Any]) -> dict[str, float]:
    """Return the terms of a part of a result, and the loss, as `loss`."""
    return {**stage["terms"], "loss": stage["loss"]}


def _table(summary: Mapping[str, Any]) -> str:
    """Return a row a seed, and rows of the mean and of both ends of its interval."""
    columns = [(stage, name) for stage, numbers in summary["all"].items() for name in numbers]
    text = io.StringIO(newline="")
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(["seed", "run", "status", "iterations", *(f"{stage}:{name}" for stage, name in columns)])
    for seed, entry in summary["seeds"].items():
        numbers = [repr(entry[stage][name]) if stage in entry else "" for stage, name in columns]
        rows.writerow([seed, entry["run"], entry["status"], entry.get("iterations", ""), *numbers])
    for end in ("mean", "low", "high"):
        of_all = (summary["all"][stage][name][end] for stage, name in columns)
        rows.writerow([end, "", "", "", *("" if value is None else repr(value) for value in of_all)])
    return text.getvalue()


def summary_lines(path: Path) -> list[str]:
    """Return a summary as lines for a terminal."""
    summary = json.loads(path.read_text())
    seeds = list(summary["seeds"].values())
    good = [entry for entry in seeds if entry["status"] != "failed"]
    lines = [f"{len(good)} of {len(seeds)} seeds learned; mean and {summary['confidence']:.0%} interval over them", ""]
    stages = list(summary["all"])
    if stages:
        head = ("term", *(STAGES[stage] for stage in stages))
        names = list(summary["all"][stages[0]])
        lines += table(head, [(name, *(_shown(summary["all"][stage][name]) for stage in stages)) for name in names])
    lines += [f"seed {k} failed: {e['reason']}" for k, e in summary["seeds"].items() if e["status"] == "failed"]
    spread = summary["all"].get("trained", {}).get("loss", {})
    if len(good) > 1 and spread["low"] == spread["high"]:
        lines.append("note: every seed found the same: nothing in this scene is drawn from its seed")
    if good:
        lines += ["", "draw them together: cqrun plot " + " ".join(entry["run"] for entry in good)]
    return [*lines, f"summary: {path}"]


def _shown(entry: Mapping[str, float | None]) -> str:
    mean, low, high = (entry[key] for key in ("mean", "low", "high"))
    assert mean is not None
    return number(mean) if low is None or high is None else f"{number(mean)} ({number(low)} to {number(high)})"
