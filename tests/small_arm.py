"""A soft 2D arm at rest, with two cables and a load at its tip, and recordings of its poses that the model makes."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cqrun.build.load_path import inputs_of
from cqrun.build.matter import matter_of
from cqrun.build.model import Built, build
from cqrun.engine.statics.path import RestPath, RestRecords
from cqrun.fitting.cases import given_cases
from cqrun.fitting.problem import FitProblem
from cqrun.measurements.markers import observe_markers, over_body
from cqrun.running.unknowns import make_params
from cqrun.scene.load import load_scene

ARM = """\
cqrun: 1
title: a small arm at rest
world: {size: [0.2, 0.12], dx: 0.01, frame: reference, gravity: [0, -9.81]}
bodies:
  arm:
    shape: {box: {corner: [0.02, 0.05], size: [0.12, 0.02]}}
    particles_per_cell: 4
    material: {density: 1000, elastic: {fixed_corotated: {youngs_modulus: 1.0e5, poissons_ratio: 0.3}}}
boundaries:
  clamp: {sticky: {region: {box: {corner: [0, 0], size: [0.04, 0.12]}}}}
loads:
  push: {point_force: {body: arm, force: [0, 0], region: {box: {corner: [0.13, 0.05], size: [0.01, 0.02]}}}}
actuators:
  upper: {cable: {body: arm, route: [[0.03, 0.065], [0.13, 0.065]], spacing: 0.01, tension: 0}}
  lower: {cable: {body: arm, route: [[0.03, 0.055], [0.13, 0.055]], spacing: 0.01, tension: 0}}
activation: {signals: {upper: [1], lower: [1]}}
time: {duration: 0.02, control_step: 0.01}
"""

E = "bodies.arm.material.elastic.fixed_corotated.youngs_modulus"
NU = "bodies.arm.material.elastic.fixed_corotated.poissons_ratio"
UPPER, LOWER = "actuators.upper.cable.tension", "actuators.lower.cable.tension"
PUSH = "loads.push.point_force.force.1"
TRUE = 1.4e5
"""Young's modulus that the recordings are made with [Pa]."""

MARKERS = {"tip": [0.139, 0.06], "stem": [0.1, 0.08]}
"""Rest positions: one on the body, and one on a stem above it."""

LOADS = {"upper_N": UPPER, "lower_N": LOWER, "push_N": PUSH}
POSES: dict[str, tuple[float, float, float]] = {
    "hanging": (0.0, 0.0, 0.0), "up": (60.0, 0.0, 0.0), "up more": (150.0, 0.0, 0.0), "down": (0.0, 80.0, 0.0),
    "pushed": (60.0, 0.0, 0.4),
}  # fmt: skip
"""Tensions of the cables and the push at the tip [N/m], by pose."""

NOISE = 2e-5
"""Standard deviation of each coordinate [m]."""

POSES_OF = "{upper_N: actuators.upper.cable.tension, lower_N: actuators.lower.cable.tension, " \
    "push_N: loads.push.point_force.force.1}"  # fmt: skip
"""The loads of the recordings, in a scene."""


def rested(
    overrides: Sequence[str], points: Sequence[Mapping[str, float]], scene: str = ARM
) -> tuple[Built, RestRecords, np.ndarray]:
    """Return the arm, the records of its equilibria, and the places of the markers (P + 1, M, D) [m]."""
    built = build(load_scene(scene, overrides))
    matter = matter_of(built, {})
    observer = observe_markers(matter, "arm", {name: np.array(x) for name, x in MARKERS.items()})
    model = replace(built.model, probe=over_body(observer.rows, "arm", matter))
    path = RestPath(model, [inputs_of(built, point) for point in points], tolerance=1e-11)
    records = path.run()
    assert all(point.rest.converged for point in path.points)
    return built, records, observer.observe(records)[0]


def write_poses(file: Path, *, E_true: float = TRUE, seed: int = 1, wide: bool = False, unit: str = "m",
                offset: Sequence[float] = (0, 0), rotation: float = 0.0,
                overrides: Sequence[str] = ()) -> Path:  # fmt: skip
    """Write the poses of an arm with noise, in the long form or in the wide one, and return their file.

    Args:
        offset: subtracted from the positions [m], so that a recording with this `offset` fits.
        rotation: by which the positions are turned back then [rad], so that one with this `rotation` fits.
    """
    points = [dict(zip(LOADS.values(), loads, strict=True)) for loads in POSES.values()]
    _, _, places = rested([f"{E}={E_true}", *overrides], points)
    places = places[1:] + NOISE * np.random.default_rng(seed).normal(size=places[1:].shape) - np.array(offset)
    cosine, sine = np.cos(rotation), np.sin(rotation)
    places = places @ np.array([[cosine, -sine], [sine, cosine]]) * {"m": 1.0, "mm": 1e3}[unit]
    end = "" if unit == "m" else f"_{unit}"
    with file.open("w", newline="") as text:
        rows = csv.writer(text)
        if wide:
            rows.writerow(["pose", *LOADS, *(f"{name}_{axis}{end}" for name in MARKERS for axis in "xy")])
            rows.writerows([pose, *loads, *x.ravel()] for (pose, loads), x in zip(POSES.items(), places, strict=True))
        else:
            rows.writerow(["pose", *LOADS, "marker", f"x{end}", f"y{end}"])
            for (pose, loads), of_pose in zip(POSES.items(), places, strict=True):
                rows.writerows([pose, *loads, name, *x] for name, x in zip(MARKERS, of_pose, strict=True))
    return file


def markers_text() -> str:
    """Return the markers as YAML."""
    return "{" + ", ".join(f"{name}: {place}" for name, place in MARKERS.items()) + "}"


def scene_of(folder: Path, recordings: str, unknowns: str = "", name: str = "arm.yaml") -> Path:
    """Write a scene that is fitted to recordings, which are lines of YAML, and return its file."""
    file, bounds = folder / name, unknowns or f"  {E}: {{bounds: [5.0e4, 4.0e5], scale: log}}\n"
    file.write_text(
        f"{ARM}data:\n  recordings:\n{recordings}unknowns:\n{bounds}"
        "optimizer: {least_squares: {max_iterations: 15}}\n"
    )
    return file


def recording(name: str = "arm", file: str = "poses.csv", **more: str) -> str:
    """Return a recording of poses as a line of YAML; `more` are its other keys."""
    given = "".join(f", {key}: {value}" for key, value in more.items())
    return f"    {name}: {{file: {file}, poses: {{loads: {POSES_OF}, markers: {markers_text()}}}{given}}}\n"


def problem_of(scene: Path, *overrides: str) -> FitProblem:
    """Return the problem of a scene's fit."""
    built = build(load_scene(scene, overrides))
    cases = given_cases(built)
    assert cases is not None
    return FitProblem(cases, make_params(built))
