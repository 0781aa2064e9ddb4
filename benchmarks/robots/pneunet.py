"""Bend angle against pressure of scenes/robots/pneunet.yaml: finite elements, and cqrun on three grids.

    python -m benchmarks.robots.pneunet [--only fem coarse ...] [--pressures PA PA ...] [--threads N] [--out FILE]

`fem` and `fem_coarse` are finite elements of second order on two meshes (finite_elements.py): their difference tells
how exact they are. The grids run the scene itself. Pressures are those of the scene if none are given. Each part is
written when it is done, and a part that is in the file is not computed again.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.robots.finite_elements import Box, SoftBody
from cqrun.fingerprint import engine_hash
from cqrun.jobs.rest import REST
from cqrun.scene.load import load_scene
from cqrun.scene.load_path import values_of
from cqrun.scene.schema import Scene
from cqrun.store.atomic import write_json
from cqrun.store.trajectory import read_trajectory
from scenes.robots.meshes.make_meshes import pneunet

ROOT = Path(__file__).parents[2]
SCENE = ROOT / "scenes" / "robots" / "pneunet.yaml"
OUT = ROOT / "benchmarks" / "measured" / "pneunet.json"

ELEMENTS = {"fem_coarse": 0.004, "fem": 0.002}
"""Name -> size of elements [m], at most."""

GRIDS = {"coarse": 0.0013333333, "middle": 0.001, "fine": 0.0006666667}
"""Name -> cell [m]; particles are half a cell apart."""

MM, HALF_WIDTH = 1e-3, 10.0


def half(boxes: list[Any]) -> list[Box]:
    """Return the half of boxes [mm] beyond the middle of the width, from there on [m]."""
    return [tuple(np.array([(x[k], max(y[k] - HALF_WIDTH, 0.0), z[k]) for k in (0, 1)]) * MM) for x, y, z in boxes]


def pressures_of(scene: Scene) -> list[float]:
    """Return the pressures of the scene's path [Pa]."""
    return values_of(scene.path["actuators.air.chamber.pressure"])


def finite_elements(size: float, pressures: list[float]) -> dict[str, Any]:
    """Return what finite elements say at some pressures [Pa]."""
    scene = load_scene(SCENE)
    material: Any = scene.bodies["actuator"].material
    fibre: Any = scene.bodies["actuator"].material_of["layer"].terms["fibre"]
    law = material.elastic.value
    assert fibre.tension_only  # as those of finite_elements.py
    thin: list[Box] = [((0, 0, 0), (0.1, 0.01, 0.001))]
    solid, hollow = (half(boxes) for boxes in pneunet())
    body = SoftBody(
        [*solid, *thin], hollow, size, law.youngs_modulus, law.poissons_ratio,
        [(thin, 0, fibre.stiffness), (thin, 1, fibre.stiffness)],
    )  # fmt: skip
    begin = time.perf_counter()
    found = body.solve(pressures, lambda line: print(line, flush=True))
    tip: list[Box] = [((0.098, 0, 0), (0.1, 0.01, 0.02))]
    return {
        "unknowns": len(body.free),
        "pressure": pressures,
        "angle": [abs(float(body.turned(u, tip))) for u in found],
        "volume": [body.volume(u) for u in found],
        "seconds": time.perf_counter() - begin,
    }


def on_grid(dx: float, pressures: list[float], threads: int | None, runs: Path) -> dict[str, Any]:
    """Return what the scene says on cells of dx [m] at some pressures [Pa]."""
    path = f"path.actuators.air.chamber.pressure={pressures}"
    overrides = [f"world.dx={dx!r}", f"bodies.actuator.spacing={dx / 2!r}", path]
    begin = time.perf_counter()
    run = REST.run(SCENE, overrides, runs, threads=threads)
    measured = read_trajectory(run / "trajectory.h5").measured
    assert measured is not None
    angle, volume = (measured.quantities[name].values[1:, 0] for name in ("angle", "volume"))
    return {
        "dx": dx,
        "particles": len(read_trajectory(run / "trajectory.h5").fields["x"][0]),
        "pressure": pressures,
        "angle": angle.tolist(),
        "volume": volume.tolist(),
        "seconds": time.perf_counter() - begin,
        "peak_bytes": 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        "engine": engine_hash(),
    }


def main() -> None:
    """Compute the parts that are missing, and write the file after each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=[*ELEMENTS, *GRIDS], default=[*ELEMENTS, *GRIDS])
    parser.add_argument("--pressures", nargs="+", type=float, default=pressures_of(load_scene(SCENE)))
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--runs", type=Path, default=Path("results") / "pneunet")
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args()
    result = json.loads(options.out.read_text()) if options.out.exists() else {}
    for name in options.only:
        if name not in result:
            size = ELEMENTS.get(name)
            result[name] = (
                on_grid(GRIDS[name], options.pressures, options.threads, options.runs)
                if size is None
                else finite_elements(size, options.pressures)
            )
            write_json(options.out, result)
        angles = ", ".join(f"{np.degrees(angle):.2f}" for angle in result[name]["angle"])
        print(f"{name}: {angles} degrees", flush=True)


if __name__ == "__main__":
    main()
