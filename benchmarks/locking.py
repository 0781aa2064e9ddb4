"""Measure how much too little a nearly incompressible beam bends if its volumes are not averaged, on several grids.

    python benchmarks/locking.py [--cells 2 3 4 6 8] [--out FILE]

A square beam, eight times as long as it is thick, is clamped at one end and sags a little under its own weight. It is
compared with its sag at a Poisson's ratio of 0.3 on the same grid, where nothing locks: the bending stiffness of a
slender beam is E I, whatever the ratio. build/volumes.py has the formula that is fitted to the table. On one busy core
it takes five minutes, most of them with 8 cells.
"""

from __future__ import annotations

import argparse
import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.sparse import csr_array

from cqrun.build.load_path import inputs_of
from cqrun.build.model import build
from cqrun.engine.statics.path import RestPath
from cqrun.scene.load import load_scene

ROOT = Path(__file__).parents[1]
SLENDER, THICK, YOUNG, DENSITY = 8, 0.02, 3e5, 1000.0
RATIOS = (0.3, 0.45, 0.49, 0.499, 0.4999)


def sag(cells: int, ratio: float, volume: str, gravity: float = 0.1) -> float:
    """Return how far the end of the beam sags [m]."""
    dx = THICK / cells
    low, held = 4 * dx, 4 * dx
    scene = {
        "cqrun": 1,
        "world": {"size": [SLENDER * THICK + held + 12 * dx, THICK + 12 * dx, THICK + 12 * dx], "dx": dx,
                  "gravity": [0, 0, -gravity], "volume": volume, "frame": "reference"},
        "bodies": {"beam": {
            "shape": {"box": {"corner": [low, low, low], "size": [SLENDER * THICK + held, THICK, THICK]}},
            "particles_per_cell": 8,
            "material": {"density": DENSITY, "elastic": {
                "neo_hookean": {"youngs_modulus": YOUNG, "poissons_ratio": ratio}}},
        }},
        "boundaries": {"clamp": {"sticky": {"region": {"box": {"corner": [0, 0, 0], "size": [low + held, 1, 1]}}}}},
        "time": {"duration": 0.01, "control_step": 0.01},
    }  # fmt: skip
    built = build(load_scene(scene))
    x = built.particles.x[:, 0]
    end = x > x.max() - 0.25 * dx
    model = replace(built.model, probe=csr_array(end[None] / end.sum()))
    path = RestPath(model, [inputs_of(built, {}, {})], threads=1)
    records = path.run()
    return float(records.x[0, 0, 2] - records.x[1, 0, 2])


def main() -> None:
    """Print and write the table, a line for each grid and ratio."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, nargs="+", default=[2, 3, 4, 6, 8])
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "measured" / "locking.csv")
    options = parser.parse_args()
    rows: list[list[object]] = [["cells", "poissons_ratio", "volume", "sag_m", "part_of_that_at_0.3"]]
    for cells in options.cells:
        free = np.nan
        for ratio in RATIOS:
            down = sag(cells, ratio, "local")
            free = down if ratio == RATIOS[0] else free
            rows.append([cells, ratio, "local", f"{down:.6g}", f"{down / free:.4f}"])
            print(*rows[-1], flush=True)
        with options.out.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(rows)


if __name__ == "__main__":
    main()
