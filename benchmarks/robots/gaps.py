"""How stiff a gap is in one body, by the cells across it: a strip with blocks on it, which bends under its weight (2D).

    python -m benchmarks.robots.gaps [--out FILE]

The strip is 2 mm thick, and the gaps between the blocks are 2 mm wide. Blocks are stiff, so the strip bends in the gaps
alone. A plain strip shows what its thickness does without gaps. Each body is compared with itself on the finest grid.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
from pathlib import Path

import yaml

from cqrun.jobs.rest import REST
from cqrun.store.trajectory import read_trajectory

OUT = Path(__file__).parents[1] / "measured" / "gaps.csv"
GAP, CELLS = 0.002, (2, 3, 4, 6, 8)
STRIP = {"corner": [0.002, 0.015], "size": [0.05, GAP]}
BLOCKS = [{"corner": [0.012 + 0.008 * k, 0.017], "size": [0.006, 0.008]} for k in range(5)]
BODIES = {"strip with blocks": [STRIP, *BLOCKS], "plain strip": [STRIP]}


def scene(boxes: list[dict[str, list[float]]], dx: float) -> dict[str, object]:
    """Return the scene of a body of boxes on cells of dx [m]."""
    body = {
        "shape": {"union": [{"box": box} for box in boxes]},
        "spacing": dx / 2,
        "groups": {"tip": {"box": {"corner": [0.05, 0.0], "size": [0.002, 0.03]}}},
        "material": {"density": 1000, "elastic": {"neo_hookean": {"youngs_modulus": 3.0e5, "poissons_ratio": 0.45}}},
    }
    clamp = {"box": {"corner": [0.0, 0.0], "size": [0.012, 0.03]}}
    return {
        "cqrun": 1,
        "title": "A gap in a body",
        "job": "rest",
        "world": {"size": [0.06, 0.03], "dx": dx, "frame": "reference", "gravity": [0, -0.1]},
        "bodies": {"beam": body},
        "boundaries": {"mount": {"sticky": {"region": clamp}}},
        "measure": {"tip": {"displacement": {"group": "tip"}}},
    }


def sag(boxes: list[dict[str, list[float]]], dx: float) -> float:
    """Return how far the tip sags [m]."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "gap.yaml"
        path.write_text(yaml.safe_dump(scene(boxes, dx)), encoding="utf-8")
        run = REST.run(path, [], Path(folder) / "runs", threads=1)
        measured = read_trajectory(run / "trajectory.h5").measured
        assert measured is not None
        return -float(measured.quantities["tip"].values[-1, 1])


def main() -> None:
    """Measure all, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=OUT)
    out = parser.parse_args().out
    rows = []
    for name, boxes in BODIES.items():
        sags = {n: sag(boxes, GAP / n) for n in CELLS}
        finest = sags[max(CELLS)]
        rows += [[name, n, f"{s * 1e3:.4f}", f"{s / finest - 1:+.3f}"] for n, s in sags.items()]
    with out.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["body", "cells_across_gap", "sag_mm", "relative_to_finest"])
        writer.writerows(rows)
    for row in rows:
        print(*row, sep="  ")


if __name__ == "__main__":
    main()
