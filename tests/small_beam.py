"""A soft 2D beam of 40 particles with synthetic data: whole jobs take a second, all with the same kernels."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

from cqrun.running.reporter import Silent

BEAM = """\
# yaml-language-server: $schema=../cqrun.schema.json
cqrun: 1
title: a small cantilever
world: {size: [0.16, 0.12], dx: 0.01, gravity: [0, -9.81], frame: updated}
bodies:
  beam:
    shape: {box: {corner: [0.02, 0.06], size: [0.1, 0.01]}}
    particles_per_cell: 4
    groups: {root: {box: {corner: [0.02, 0.06], size: [0.05, 0.01]}}}
    material:
      density: 1000
      elastic: {fixed_corotated: {youngs_modulus: 3.0e4, poissons_ratio: 0.3}}
      viscosity: {shear: 3}
boundaries:
  clamp: {sticky: {region: {box: {corner: [0, 0], size: [0.04, 0.12]}}}}
time: {duration: 0.1, control_step: 0.01, substeps: 24}
"""

FIT = """\
data:
  synthetic:
    body: beam
    truth:
      bodies.beam.material.elastic.fixed_corotated.youngs_modulus: 4.0e4
      bodies.beam.material.viscosity.shear: 6
    noise: 2.0e-5
    every: 1
    markers: {tip: [0.119, 0.065], middle: [0.08, 0.065]}
unknowns:
  bodies.beam.material.elastic.fixed_corotated.youngs_modulus: {bounds: [1.0e4, 1.0e5], scale: log}
  bodies.beam.material.viscosity.shear: {bounds: [0.5, 20], scale: log}
optimizer: {least_squares: {max_iterations: 8}}
"""

MARKERS = {"tip": [0.119, 0.065], "middle": [0.08, 0.065]}
"""Rest positions of the markers of the fit."""

E_PATH = "bodies.beam.material.elastic.fixed_corotated.youngs_modulus"
SHEAR_PATH = "bodies.beam.material.viscosity.shear"

THIN = ("bodies.beam.shape: is 1 cell thick", "bodies.finger.parts: is 2 cells thick")
"""Warnings about the small scenes themselves, which are thin so that tests are fast."""


class Listener(Silent):
    """A reporter that keeps all messages except THIN, and may ask to stop after a number of reports."""

    def __init__(self, stop_after: int | None = None) -> None:
        super().__init__()
        self.said: list[str] = []
        self.updates: list[tuple[int, float]] = []
        self.parts: list[tuple[int, int, str]] = []
        self.stop_after = stop_after

    def phase(self, text: str) -> None:
        self.said.append(text)

    def say(self, text: str) -> None:
        self.said.append(text)

    def warn(self, text: str) -> None:
        if not any(thin in text for thin in THIN):
            self.said.append(f"warning: {text}")

    def update(
        self, iteration: int, loss: float, best: float, step: float, seconds: float, violation: float | None = None
    ) -> None:
        self.updates.append((iteration, loss))
        self._count()

    def advance(self, done: int, total: int, text: str) -> None:
        self.parts.append((done, total, text))
        self._count()

    def _count(self) -> None:
        if self.stop_after is not None and len(self.updates) + len(self.parts) >= self.stop_after:
            self.stop.ask()


def result_of(run: Path) -> dict[str, Any]:
    """Return result.json."""
    return json.loads((run / "result.json").read_text())


def contents(run: Path) -> dict[str, bytes | list[list[str]]]:
    """Return the files that must be the same in equal runs.

    These are all files except the log, run.json, the lock, the report and the figures, and the history without its
    seconds.
    """
    files: dict[str, bytes | list[list[str]]] = {}
    for path in sorted(run.rglob("*")):
        name = str(path.relative_to(run))
        if path.is_dir() or name in ("run.json", "log.txt", "lock", "report.html") or path.parent.name == "figures":
            continue
        if name == "history.csv":
            rows = list(csv.reader(path.read_text().splitlines()))
            assert rows[0][-2:] == ["seconds", "crc32"]
            files[name] = [row[:-2] for row in rows]
        else:
            files[name] = path.read_bytes()
    return files


def assert_same(run: Path, other: Path) -> None:
    """Fail if two runs differ, and name the files."""
    mine, theirs = contents(run), contents(other)
    assert mine.keys() == theirs.keys(), mine.keys() ^ theirs.keys()
    different = [name for name in mine if mine[name] != theirs[name]]
    assert not different, f"{run}: {different}"


def record(scene: Path, file: Path, *, copies: int = 1) -> list[Path]:
    """Write the scene of the small beam, make its synthetic data as recordings, and return their files."""
    from cqrun.build.model import build
    from cqrun.fitting.cases import make_cases
    from cqrun.fitting.synthetic import SYNTHETIC
    from cqrun.scene.load import load_scene

    scene.write_text(BEAM + FIT)
    make_cases(build(load_scene(scene, [f"data.synthetic.copies={copies}"])), file)
    return sorted((file / SYNTHETIC).glob("*.csv"))


def recorded(scene: Path, files: dict[str, Path], **entries: str) -> Path:
    """Write a scene that is fitted to recordings (name -> file); `entries` are added to each recording as YAML."""
    markers = ", ".join(f"{name}: {place}" for name, place in MARKERS.items())
    spec = {"markers": f"{{{markers}}}", **entries}
    lines = ["data:", "  recordings:"]
    for name, file in files.items():
        inside = ", ".join(f"{key}: {value}" for key, value in {"file": file, **spec}.items())
        lines.append(f"    {name}: {{{inside}}}")
    scene.write_text(BEAM + "\n".join(lines) + "\n" + FIT[FIT.index("unknowns:") :])
    return scene


def changed(path: Path, old: str, new: str) -> Path:
    """Replace text in a scene."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    return path
