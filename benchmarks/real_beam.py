"""Fit the material of the real beam to its swing, its rest and both, on two grids; predict the loaded beam.

    python benchmarks/real_beam.py --recordings DIR [--only swing rest ...] [--source-clamp] [--runs DIR] [--out FILE]
    python benchmarks/real_beam.py --recordings DIR --check NAME ... [--out FILE]

DIR holds beam_gravity_V2_a.c3d and beam_load101_V2_a.c3d (srl-ethz/diffPD_sim2real, MIT licence). Each fit is a run of
`cqrun sysid` below `--runs`. A stopped fit continues, and a finished one is read. On two cores, a fit at 5 mm takes
40 minutes (swing) or a minute or two (rest). A fit at 3.75 mm takes two hours (swing) or three minutes (rest).
`material` is one fit of swing and rest, with a stress that relaxes; it takes about as long as that of the swing. With
`--source-clamp`, the clamp ends where the source of the recordings says, 5 mm before that of the scenes.
"""

from __future__ import annotations

import argparse
import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.build.model import build
from cqrun.fingerprint import engine_hash
from cqrun.fitting.cases import make_cases
from cqrun.jobs.sysid import run_sysid
from cqrun.running.threads import cores
from cqrun.scene.load import load_scene
from cqrun.store.atomic import write_json
from cqrun.store.result import SysidResult, require_result

ROOT = Path(__file__).parents[1]
SWING, REST, MATERIAL = (
    ROOT / "scenes" / "sysid" / f"{name}.yaml" for name in ("real_beam", "real_beam_rest", "real_beam_material")
)
FINE = ["world.dx=0.00375"]
TILTS = {name: f"data.recordings.{name}.overrides.world.gravity.1" for name in ("bare", "loaded")}
"""Recording -> key path of the sideways part of its gravity."""

SOURCE_CLAMP = ["boundaries.clamp.sticky.region.box.size.0=0.04"]

MODULUS = "bodies.beam.material.elastic.fixed_corotated.youngs_modulus"

HELD_OUT = ["data.recordings.loaded.holdout=true", f"unknowns.{TILTS['loaded']}=null"]
"""The loaded beam is predicted: its tilt is what the scene says."""

NEAR = [
    f"{MODULUS}=2.489e5",
    "bodies.beam.material.viscosity.shear=162.6",
    "loads.air.damping.rate=2.524",
    "data.recordings.bare.start=0.70806",
    "data.recordings.loaded.start=0.51745",
    f"{TILTS['bare']}=-0.5711",
    f"{TILTS['loaded']}=-0.562",
    "time.substeps=560",
]
"""Near the answer at 3.75 mm: an iteration takes twenty minutes. The substeps suit the viscosity there."""

NEAR_MATERIAL = [
    f"{MODULUS}=2.319e5",
    "bodies.beam.material.prony.ratio_1=0.1042",
    "bodies.beam.material.prony.time_1=0.758",
    "bodies.beam.material.viscosity.shear=149",
    "loads.air.damping.rate=2.408",
    "data.recordings.bare.start=0.71155",
    "data.recordings.loaded.start=0.52109",
    "time.substeps=620",
]
"""The same for swing and rest at once: the values found at 5 mm."""

FITS: dict[str, tuple[Path, list[str]]] = {
    "rest": (REST, []),
    "rest_bare": (REST, HELD_OUT),
    "rest_fine": (REST, FINE),
    "swing": (SWING, []),
    "swing_bare": (SWING, [*HELD_OUT, "unknowns.data.recordings.loaded.start=null"]),
    "swing_fine": (SWING, [*FINE, *NEAR]),
    "material": (MATERIAL, []),
    "material_fine": (MATERIAL, [*FINE, *NEAR_MATERIAL]),
}
"""Name -> scene and overrides."""


def files(scene: Path, recordings: Path) -> list[str]:
    """Return the overrides that name the files of a scene's recordings."""
    data = load_scene(scene).data
    assert data is not None
    assert data.recordings is not None
    return [f"data.recordings.{name}.file={recordings / each.file}" for name, each in data.recordings.items()]


def fit(name: str, recordings: Path, runs: Path, more: Sequence[str] = ()) -> dict[str, Any]:
    """Run one fit, or continue it, with more overrides; return what it found."""
    scene, overrides = FITS[name][0], [*FITS[name][1], *more]
    run = run_sysid(scene, [*files(scene, recordings), *overrides], runs / name)
    result = require_result(run, SysidResult)
    facts = json.loads((run / "run.json").read_text())
    words = [word for override in overrides for word in ("-o", override)]
    return {
        "command": shlex.join(["cqrun", "sysid", f"scenes/sysid/{scene.name}", *words]),
        "engine": facts["engine"],
        **result.model_dump(include={"status", "iterations", "unknowns", "moduli", "recordings", "findings"}),
    }


def predicted_rest(found: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, float]:
    """Return the RMSE [mm] of both beams at rest, with the values from the swing of the bare beam alone."""
    young, tilt = (found["unknowns"][path]["value"] for path in (MODULUS, TILTS["bare"]))
    values = [f"{MODULUS}={young!r}", *(f"{path}={tilt!r}" for path in TILTS.values())]
    return errors_of(REST, [*overrides, *values])


def errors_of(scene: Path, overrides: Sequence[str]) -> dict[str, float]:
    """Return the RMSE [mm] of each recording with the values that a scene has."""
    errors = {}
    for case in make_cases(build(load_scene(scene, overrides))):
        record = case.run({}, cores(None))
        errors[case.name] = 1e3 * float(np.sqrt(case.comparisons[0].loss(record, case.start)))
    return errors


def checked(name: str, found: Mapping[str, Any], recordings: Path) -> dict[str, Any]:
    """Return what this engine says with the values that a fit has found: the RMSE [mm] of each recording."""
    scene, overrides = FITS[name]
    more = [*files(scene, recordings), *overrides]
    for path, unknown in load_scene(scene, more).unknowns.items():
        value = found["unknowns"][path]["value"]
        more += [f"{each}={value!r}" for each in (path, *unknown.also)]
    errors = errors_of(scene, more)
    print(f"{name}: RMSE [mm] {errors}", flush=True)
    return {"engine": engine_hash(), "rmse_mm": errors}


def main() -> None:
    """Run the fits, and write the file after each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--recordings", type=Path, required=True)
    parser.add_argument("--only", nargs="+", choices=list(FITS), default=list(FITS))
    parser.add_argument("--check", nargs="+", choices=list(FITS), default=[],
                        help="compute only the errors with the values in the file, with this engine")  # fmt: skip
    parser.add_argument("--source-clamp", action="store_true")
    parser.add_argument("--runs", type=Path, default=Path("results") / "real_beam")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "measured" / "real_beam.json")
    options = parser.parse_args()
    more = SOURCE_CLAMP if options.source_clamp else []
    every = json.loads(options.out.read_text()) if options.out.exists() else {}
    result = every.setdefault("source_clamp", {}) if options.source_clamp else every
    for name in options.check:
        result[name]["checked"] = checked(name, result[name], options.recordings)
        write_json(options.out, every)
    for name in [] if options.check else options.only:
        result[name] = fit(name, options.recordings, options.runs, more)
        if name == "swing_bare":
            result["rest_predicted_from_swing_bare_mm"] = predicted_rest(
                result[name], [*files(REST, options.recordings), *more]
            )
        source = {"command": "python benchmarks/real_beam.py --recordings DIR", "engine": engine_hash()}
        write_json(options.out, {**every, **source})
        errors = {k: round(v["rmse_mm"], 3) for k, v in result[name]["recordings"].items()}
        print(f"{name}: E {result[name]['unknowns'][MODULUS]['value'] / 1e3:.1f} kPa, RMSE [mm] {errors}", flush=True)


if __name__ == "__main__":
    main()
