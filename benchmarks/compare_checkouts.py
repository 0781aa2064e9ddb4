"""Compare two checkouts of cqrun: does every shipped scene have the same trajectory, loss and gradient?

    python benchmarks/compare_checkouts.py BEFORE AFTER [--only NAME ...] [--out FILE.json]

BEFORE and AFTER are folders with a checkout and its environment in `.venv`. In each of them a worker runs the scenes of
that checkout, shortened to three control steps and a few particles, through `cqrun.load` alone, so that the modules of
the two checkouts may lie anywhere. A difference is the largest one of an array over the array's largest number. The
exit code is 1 if a difference exceeds 1e-12 or a scene fails. The first comparison compiles all kernels, which takes
about ten minutes of CPU time for each checkout.

A scene whose language has changed between the checkouts needs other overrides in one of them:

    ... --before-override collision:data.target.body=b --after-override collision:objective.there.reach.body=b

Scenes with recordings read them from `../shared/data/realbeam` beside AFTER; without that folder they are skipped.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

LIMIT = 1e-12
"""Largest relative difference that counts as the same."""

STEPS = 3
"""Control steps of a shortened scene."""

RECORDINGS = Path("..", "shared", "data", "realbeam")

COLUMNS = ("trajectory", "loss", "gradient")

SMALLER: dict[str, list[str]] = {
    "real_beam": ["world.dx=0.01"],
    "real_beam_rest": ["world.dx=0.01"],
    "collision": ["bodies.a.shape.ball.center=[0.3, 0.4416]"],  # the balls touch from the start
    "finger_material": ["activation.random.sequences=2", "data.synthetic.copies=2"],
    "finger": ["bodies.finger.sampling.lattice.count=10"],
    "finger_random": ["bodies.finger.sampling.lattice.count=10"],
    "finger_wide": ["bodies.finger.sampling.lattice.count=10"],
    "biped": ["bodies.biped.sampling.lattice.count=6"],
    "biped_cable": ["bodies.biped.spacing=0.00625"],
    "rhino": ["bodies.rhino.spacing=0.01", "time.substeps=2"],
    "biped_terrain": ["bodies.biped.sampling.lattice.count=8", "bodies.terrain.spacing=0.0125",
                      "bodies.biped.place.offset=[0.2, 0.115]"],  # the feet touch the hills from the start
    "quadruped": ["bodies.quadruped.sampling.lattice.count=5", "time.substeps=2"],
    "crawler": ["bodies.crawler.sampling.lattice.count=4", "time.substeps=2"],
    "arm_reach_3d": ["bodies.arm.sampling.lattice.count=4", "episodes.count=2"],
    "leg_actuate": ["bodies.leg.spacing=0.5", "world.dx=1.6", "time.substeps=40"],
    "leg_drop": ["bodies.leg.spacing=0.5", "world.dx=1.6", "time.substeps=40",
                 "bodies.leg.place={offset: [0, -15, 0]}"],  # the leg touches the floor from the start
    "arm_two_link": ["bodies.arm.sampling.lattice.count=10"],
    "arm_3d": ["bodies.arm.sampling.lattice.count=4"],
    "biped_codesign": ["bodies.biped.sampling.lattice.count=10"],
    "quadruped_codesign": ["bodies.quadruped.sampling.lattice.count=3"],
    "hexapod_codesign": ["bodies.hexapod.sampling.lattice.count=3"],
    "octopod_codesign": ["bodies.octopod.sampling.lattice.count=3"],
    "creature": ["bodies.creature.spacing=0.02", "time.substeps=2"],
}  # fmt: skip
"""What makes a scene smaller, as tests/test_scenes.py does."""

TWO_THREADS = ("collision", "quadruped")
"""Scenes in 2D and 3D with enough particles for a second thread."""

WITHOUT_LOSS: dict[str, tuple[str, str]] = {
    "leg_drop": ("leg", "fixed_corotated"),
    "leg_actuate": ("leg", "fixed_corotated"),
    "oscillator": ("bar", "neo_hookean"),
    "tear": ("bar", "neo_hookean"),
}
"""Scenes without a loss: their body and its elastic law. They get the loss of a fit to synthetic data."""

Arrays = Mapping[str, Any]
"""What a worker has found of a scene: x, v, loss, gradient.<key path>, ... and `seconds`; or `error`, a text."""


def scenes_of(checkout: Path) -> dict[str, Path]:
    """Return the files of a checkout's scenes by name."""
    return {path.stem: path for path in sorted((checkout / "scenes").rglob("*.yaml"))}


def shortened(name: str, scene: Mapping[str, Any], recordings: Path) -> list[str]:
    """Return the overrides that make a scene take seconds."""
    end = STEPS * float(scene["time"]["control_step"])
    overrides = [*SMALLER.get(name, []), f"time.duration={end!r}"]
    for key, entry in scene.get("data", {}).get("recordings", {}).items():
        path = f"data.recordings.{key}"
        overrides += [f"{path}.file={recordings / entry['file']}", f"{path}.skip=0"]
        if f"{path}.start" in scene["unknowns"]:  # the bounds of a start must fit into the shorter run
            overrides.append(f"unknowns.{path}.start.bounds={[entry['start'] - 1e-3, entry['start'] + 1e-3]}")
    if name in WITHOUT_LOSS:
        body, _ = WITHOUT_LOSS[name]
        density = f"bodies.{body}.material.density: {1.1 * scene['bodies'][body]['material']['density']!r}"
        synthetic = f"{{body: {body}, truth: {{{density}}}, tracked: 20, every: 1}}"
        overrides.append(f"data={{synthetic: {synthetic}}}")
    return overrides


def parameters(name: str, scene: Mapping[str, Any], starts: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters to evaluate at, by key path.

    The controller's are moved away from their starts, where some gradients are zero. A scene without a loss has no
    unknowns, so its density and Young's modulus take their place.
    """
    found: dict[str, Any] = {}
    for path, start in starts.items():
        if path.startswith("controller."):
            found[path] = start + 0.1 * np.sin(1.0 + np.arange(start.size).reshape(start.shape))
    if name in WITHOUT_LOSS:
        body, law = WITHOUT_LOSS[name]
        material = scene["bodies"][body]["material"]
        found[f"bodies.{body}.material.density"] = float(material["density"])
        path = f"bodies.{body}.material.elastic.{law}.youngs_modulus"
        found[path] = float(material["elastic"][law]["youngs_modulus"])
    return found


def results(name: str, file: Path, extra: Sequence[str], recordings: Path) -> dict[str, Any]:
    """Run one scene and return its arrays, or the error that it ends with."""
    import yaml

    import cqrun

    begin = time.perf_counter()
    try:
        scene = yaml.safe_load(file.read_text(encoding="utf-8"))
        overrides = [*shortened(name, scene, recordings), *extra]
        problem = cqrun.load(file, overrides, threads=1 + (name in TWO_THREADS))
        values = parameters(name, scene, problem.params)
        loss, gradient, _ = problem.value_and_grad(values)
        motion = problem.simulate(values)
    except Exception:
        return {"error": traceback.format_exc(limit=-1)}
    found = {field: getattr(motion, field) for field in ("x", "v", "C", "F", "activation") if hasattr(motion, field)}
    found |= {"loss": loss} | {f"gradient.{path}": bar for path, bar in gradient.items()}
    return found | {"seconds": time.perf_counter() - begin}


def work(names: Iterable[str], extra: Mapping[str, Sequence[str]], recordings: Path, out: Path) -> None:
    """Run scenes of the checkout in the working directory; write one file of arrays each."""
    files = scenes_of(Path.cwd())
    for name in names:
        np.savez(out / f"{name}.npz", **results(name, files[name], extra.get(name, []), recordings))
        print(".", end="", file=sys.stderr, flush=True)


def start_worker(python: Path, checkout: Path, request: Mapping[str, Any]) -> subprocess.Popen[bytes]:
    """Start a worker in a checkout, on one thread unless a scene asks for two."""
    one_thread = {"NUMBA_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    environment = os.environ | one_thread | {"PYTHONPATH": str(checkout)}
    command = [str(python), str(Path(__file__).resolve()), "--worker", json.dumps(request)]
    return subprocess.Popen(command, cwd=checkout, env=environment)


def difference(before: Arrays, after: Arrays, group: str) -> float | None:
    """Return the largest relative difference of a group of arrays, None if they are bit for bit the same.

    Args:
        before, after: arrays by name.
        group: the first part of the arrays' names, such as "gradient".
    """
    names = [{name for name in found if name.split(".")[0] == group} for found in (before, after)]
    if names[0] != names[1]:
        return np.inf
    pairs = [(np.asarray(before[name]), np.asarray(after[name])) for name in names[0]]
    different = [_relative(a, b) for a, b in pairs if a.dtype != b.dtype or a.tobytes() != b.tobytes()]
    return max(different, default=None)


def _relative(a: Any, b: Any) -> float:
    if a.shape != b.shape or not (np.isfinite(a).all() and np.isfinite(b).all()):
        return np.inf
    return float(np.abs(a - b).max() / max(np.abs(a).max(), np.abs(b).max(), np.finfo(float).tiny))


def compared(before: Arrays, after: Arrays) -> dict[str, Any]:
    """Return a row of the table: the differences by group, or the errors, and the seconds."""
    errors = {when: str(found["error"]) for when, found in (("before", before), ("after", after)) if "error" in found}
    if errors:
        return {"errors": errors}
    groups = sorted({name.split(".")[0] for name in before} - {"loss", "gradient", "seconds"})
    motion = [d for d in (difference(before, after, group) for group in groups) if d is not None]
    return {
        "trajectory": max(motion, default=None),
        "loss": difference(before, after, "loss"),
        "gradient": difference(before, after, "gradient"),
        "all_zero": not any(np.any(before[name]) for name in before if name.startswith("gradient.")),
        "seconds": [round(float(found["seconds"]), 2) for found in (before, after)],
    }


def passes(row: Mapping[str, Any]) -> bool:
    """Say whether a row has no error and no difference above the limit."""
    return "errors" not in row and all(row[key] is None or row[key] <= LIMIT for key in COLUMNS)


def lines(rows: Mapping[str, Mapping[str, Any]], skipped: Mapping[str, str]) -> list[str]:
    """Return the table that is printed, and one line that sums it up."""
    shown = [f"{'scene':20}{'trajectory':>12}{'loss':>12}{'gradient':>12}{'before [s]':>12}{'after [s]':>12}"]
    for name, row in rows.items():
        if "errors" in row:
            shown += [f"{name:20}fails {when}: {error.splitlines()[-1]}" for when, error in row["errors"].items()]
            continue
        cells = ["identical" if row[key] is None else f"{row[key]:.1e}" for key in COLUMNS]
        note = "  the gradient is zero" if row["all_zero"] else ""
        shown.append(f"{name:20}" + "".join(f"{cell:>12}" for cell in [*cells, *row["seconds"]]) + note)
    shown += [f"{name:20}skipped: {reason}" for name, reason in skipped.items()]
    identical = sum(all(row.get(key, np.inf) is None for key in COLUMNS) for row in rows.values())
    bad = [name for name, row in rows.items() if not passes(row)]
    close = len(rows) - identical - len(bad)
    total = f"{len(rows)} scenes: {identical} identical, {close} within {LIMIT:g}, {len(bad)} different or failed"
    return [*shown, total + (f" ({', '.join(bad)})" if bad else "")]


def chosen(before: Path, after: Path, only: Sequence[str], recordings: Path) -> tuple[list[str], dict[str, str]]:
    """Return the scenes to compare, and those that are skipped with the reason."""
    files = [scenes_of(checkout) for checkout in (before, after)]
    wanted = [name for name in sorted(files[0].keys() | files[1].keys()) if not only or name in only]
    if unknown := set(only) - set(wanted):
        raise SystemExit(f"no scene is called {', '.join(sorted(unknown))}")
    skipped = {}
    for name in wanted:
        if name not in files[0] or name not in files[1]:
            skipped[name] = f"only {after if name in files[1] else before} has it"
        elif "recordings:" in files[1][name].read_text(encoding="utf-8") and not recordings.is_dir():
            skipped[name] = f"it needs the recordings in {recordings}"
    return [name for name in wanted if name not in skipped], skipped


def commit(checkout: Path) -> str:
    """Return the commit of a checkout, with `-dirty` if files have changed since."""
    command = ["git", "-C", str(checkout), "describe", "--always", "--dirty"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip() or "unknown"


def by_scene(texts: Sequence[str]) -> dict[str, list[str]]:
    """Return overrides by scene from texts `NAME:key.path=value`."""
    found: dict[str, list[str]] = {}
    for text in texts:
        name, _, override = text.partition(":")
        found.setdefault(name, []).append(override)
    return found


def parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return the options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="compare these scenes only")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the table as JSON")
    for when in ("before", "after"):
        parser.add_argument(
            f"--python-{when}", type=Path, metavar="FILE", help="Python of this checkout, not its .venv's"
        )
        parser.add_argument(f"--{when}-override", action="append", default=[], metavar="NAME:KEY=VALUE")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare, print the table, and return the exit code."""
    options = parsed(arguments)
    checkouts = {"before": options.before.resolve(), "after": options.after.resolve()}
    recordings = (checkouts["after"] / RECORDINGS).resolve()
    names, skipped = chosen(checkouts["before"], checkouts["after"], options.only, recordings)
    with tempfile.TemporaryDirectory() as folder:
        workers = {}
        for when, checkout in checkouts.items():
            (out := Path(folder, when)).mkdir()
            extra = by_scene(vars(options)[f"{when}_override"])
            request = {"names": names, "extra": extra, "recordings": str(recordings), "out": str(out)}
            python = vars(options)[f"python_{when}"] or checkout / ".venv" / "bin" / "python"
            workers[when] = start_worker(python, checkout, request)
        codes = {when: worker.wait() for when, worker in workers.items()}
        if any(codes.values()):
            raise SystemExit(f"a worker has failed; exit codes: {codes}")
        rows = {name: compared(*(_read(Path(folder, when, f"{name}.npz")) for when in checkouts)) for name in names}
    commits = {when: commit(checkout) for when, checkout in checkouts.items()}
    print("\n".join(["", f"before {commits['before']}, after {commits['after']}", *lines(rows, skipped)]))
    if options.out is not None:
        found = {"command": "python benchmarks/compare_checkouts.py", **commits, "scenes": rows, "skipped": skipped}
        options.out.write_text(json.dumps(found, indent=1) + "\n")
    return 0 if all(map(passes, rows.values())) else 1


def _read(file: Path) -> dict[str, Any]:
    with np.load(file) as found:
        return dict(found)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--worker"]:
        asked_for = json.loads(sys.argv[2])
        work(asked_for["names"], asked_for["extra"], Path(asked_for["recordings"]), Path(asked_for["out"]))
    else:
        sys.exit(main())
