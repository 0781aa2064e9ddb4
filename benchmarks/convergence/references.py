"""Compute the finite-element references of the clamped beam: frequency, sag under 1 g and 10 g, and swing under 1 g.

    python -m benchmarks.convergence.references [--minutes 4] [--only 2D]

Needs scikit-fem (extra `dev`). Each number is computed on several meshes. One mesh of one number is a row of
references.json; rows that are there are kept, so a stopped command continues. All meshes together take about an hour.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.convergence.cantilever import HEIGHT, LENGTH, STANDARD_GRAVITY, WIDTH, Cantilever
from benchmarks.convergence.elements import Material
from benchmarks.convergence.laws import LAWS
from benchmarks.convergence.points import REFERENCES
from benchmarks.convergence.swing_fem import swing
from benchmarks.convergence.turning_bar import HEIGHT as THICK
from benchmarks.convergence.turning_bar import LENGTH as LONG
from benchmarks.convergence.turning_bar import SPIN
from benchmarks.convergence.turning_fem import turning_bar
from cqrun.store.atomic import write_json

COMMAND = "python -m benchmarks.convergence.references"
YOUNGS_MODULUS, DENSITY = 3.0e5, 1070.0
POISSONS_RATIOS = (0.3, 0.45, 0.49, 0.499)
GRADING = 3.0
SWUNG_PERIODS = 3.0

DEFINITIONS = {
    "frequency": "first bending frequency of small vibrations about the undeformed beam [Hz]; both laws share it",
    "sag_1g": "displacement (along the beam, upwards) of the end face's mean and of its centre at rest under 1 g [m]",
    "sag_10g": "the same under 10 g [m]",
    "swing_1g": f"let go undeformed under 1 g: frequency over that of small ones, and mean height of the tip "
    f"over its height at rest, of a damped sine fitted to {SWUNG_PERIODS:g} periods",
    "turning_bar": "free bar that starts undeformed at 60 rad/s, turning steadily: stretch of positions and of F",
    "error": "relative difference of the value (finest mesh) from the one or two meshes before",
}

Mesh = tuple[int, ...]
MESHES: dict[tuple[int, str], tuple[Mesh, ...]] = {
    (2, "frequency"): ((16, 8), (24, 12), (32, 16), (48, 24)),
    (2, "sag_1g"): ((16, 8), (24, 12), (32, 16), (48, 24)),
    (2, "sag_10g"): ((24, 12), (32, 16), (40, 20), (48, 24)),
    (2, "swing_1g"): ((6, 4), (9, 6)),
    (3, "frequency"): ((12, 8, 2), (18, 10, 3), (24, 12, 3)),
    (3, "sag_1g"): ((12, 8, 2), (18, 10, 3), (24, 12, 3)),
    (3, "sag_10g"): ((9, 6, 3), (12, 8, 3), (16, 10, 3)),
    (3, "swing_1g"): ((4, 2, 1), (6, 4, 1)),
    (2, "turning_bar"): ((8, 2), (16, 4)),
    (3, "turning_bar"): ((4, 1, 1), (8, 2, 2)),
}
"""Elements along the length, through the height and through half the width, from coarse to fine; for the turning
bar, along half of each edge."""

OTHER_MESHES: dict[str, tuple[Mesh, ...]] = {
    "2D fixed_corotated nu 0.3 sag_10g": ((24, 12), (32, 16), (40, 20), (48, 24), (56, 28)),
    **{f"2D {law} nu 0.499 sag_10g": ((24, 12), (28, 14), (32, 16), (36, 18)) for law in LAWS},
    **{f"3D {law} nu 0.499 sag_10g": ((8, 4, 2), (9, 6, 3), (12, 8, 3)) for law in LAWS},
}
"""The meshes of numbers that need others. At nu .499 the creases take the most steps of Newton's method."""

CREASED = {"sag_10g"}
"""Quantities whose error compares three meshes: creases at the clamp's edges change from mesh to mesh."""


@dataclass(frozen=True)
class Point:
    """One number on one mesh."""

    dim: int
    law: str
    poissons_ratio: float
    quantity: str
    mesh: Mesh

    @property
    def group(self) -> str:
        """The name of the number."""
        return f"{self.dim}D {self.law} nu {self.poissons_ratio:g} {self.quantity}"

    @property
    def name(self) -> str:
        """The name of the row."""
        return f"{self.group} {'x'.join(map(str, self.mesh))}"


def points() -> Iterator[Point]:
    """Yield all points, the cheap ones first. The frequency does not depend on the law; it is kept under the first."""
    for (dim, quantity), meshes in MESHES.items():
        for nu in POISSONS_RATIOS:
            for law in LAWS:
                if quantity != "frequency" or law == next(iter(LAWS)):
                    group = Point(dim, law, nu, quantity, ()).group
                    yield from (Point(dim, law, nu, quantity, mesh) for mesh in OTHER_MESHES.get(group, meshes))


def measure(point: Point) -> dict[str, Any]:
    """Return the row of a point: `value`, its components by name."""
    material = Material(LAWS[point.law], YOUNGS_MODULUS, point.poissons_ratio, DENSITY)
    if point.quantity == "turning_bar":
        steady = turning_bar(material, [LONG, *[THICK] * (point.dim - 1)], SPIN, point.mesh)
        return {"value": {"stretch": steady.stretch, "stretch_of_F": steady.stretch_of_F}}
    beam = Cantilever(point.dim, point.mesh, material, grading=GRADING)
    return {"value": MEASURES[point.quantity](beam), "unknowns": int(beam.held.free.sum())}


def _frequency(beam: Cantilever) -> dict[str, float]:
    return {"frequency": beam.frequency()}


def _sag(beam: Cantilever, gravities: float) -> dict[str, float]:
    tip = beam.tip(beam.sag(gravities * STANDARD_GRAVITY, first=1.0 / gravities))
    return {
        "mean_along": float(tip.mean[0]), "mean_up": float(tip.mean[-1]),
        "centre_along": float(tip.centre[0]), "centre_up": float(tip.centre[-1]),
    }  # fmt: skip


def _swing(beam: Cantilever) -> dict[str, float]:
    found = swing(beam, STANDARD_GRAVITY, SWUNG_PERIODS)
    rest = beam.tip(beam.sag(STANDARD_GRAVITY)).mean[-1]
    return {"frequency": found.frequency / beam.frequency(), "mean_up": float(found.mean / rest)}


MEASURES: dict[str, Callable[[Cantilever], dict[str, float]]] = {
    "frequency": _frequency,
    "sag_1g": lambda beam: _sag(beam, 1.0),
    "sag_10g": lambda beam: _sag(beam, 10.0),
    "swing_1g": _swing,
}


def references(rows: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the value on the finest mesh of every number that has two meshes, with its relative error."""
    groups: dict[str, list[Point]] = {}
    for point in points():
        if "value" in rows.get(point.name, {}):
            groups.setdefault(point.group, []).append(point)
    found = {}
    for name, ladder in groups.items():
        before = 2 if ladder[0].quantity in CREASED else 1
        if len(ladder) <= before:
            continue
        *coarse, fine = (np.array(list(rows[point.name]["value"].values())) for point in ladder)
        main = int(np.argmax(np.abs(fine)))  # the error of a small component is not that of the number
        error = max(abs(other[main] / fine[main] - 1.0) for other in coarse[-before:])
        found[name] = {**rows[ladder[-1].name]["value"], "error": float(error)}
    return found


def main() -> None:
    """Compute the rows that are missing, and write the file after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=float("inf"), help="start no row after this time")
    parser.add_argument("--only", default="", help="rows whose name contains this text, such as 2D or sag_1g")
    options = parser.parse_args()
    rows = json.loads(REFERENCES.read_text())["rows"] if REFERENCES.exists() else {}
    start = time.monotonic()
    for point in points():
        if point.name in rows or options.only not in point.name:
            continue
        if time.monotonic() - start > 60.0 * options.minutes:
            print("time is up; the same command continues")
            break
        try:
            rows[point.name] = measure(point)
        except RuntimeError as error:
            rows[point.name] = {"failed": str(error)}
        print(point.name, rows[point.name], flush=True)
        write_json(REFERENCES, contents(rows))


def contents(rows: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return what references.json contains."""
    beam = {"length": LENGTH, "height": HEIGHT, "width": WIDTH, "youngs_modulus": YOUNGS_MODULUS, "density": DENSITY}
    return {
        "command": COMMAND, "definitions": DEFINITIONS, "beam": {**beam, "gravity": STANDARD_GRAVITY},
        "references": references(rows), "rows": rows,
    }  # fmt: skip


if __name__ == "__main__":
    main()
