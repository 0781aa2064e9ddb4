"""Artificial run directories with known numbers, for tests of pictures."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np

from cqrun.plugin.contract import Array
from cqrun.scene.load import dump, load_scene, resolve
from cqrun.store.trajectory import TrajectoryWriter

DURATION = 0.4
YOUNG = "material.elastic.neo_hookean.youngs_modulus"


def body(corner: list[float], **more: object) -> dict:
    material = {"density": 1000.0, "elastic": {"neo_hookean": {"youngs_modulus": 2e5, "poissons_ratio": 0.4}}}
    material["viscosity"] = {"shear": 10.0}
    shape = {"box": {"corner": corner, "size": [0.05, 0.02]}}
    return {"shape": shape, "particles_per_cell": 4, "material": material, **more}


def plane_scene(unknowns: dict, truth: dict | None = None, **more: object) -> dict:
    """Return a 2D scene of two bodies; `a` has two groups and synthetic data of two markers."""
    groups = {
        "left": {"box": {"corner": [0.02, 0.05], "size": [0.025, 0.02]}},
        "right": {"box": {"corner": [0.045, 0.05], "size": [0.025, 0.02]}},
    }
    synthetic = {
        "truth": truth or {f"bodies.a.{YOUNG}": 3e5},
        "noise": 2e-4,
        "every": 1,
        "body": "a",
        "markers": {"near": [0.03, 0.06], "far": [0.07, 0.06]},
    }
    scene = {
        "cqrun": 1,
        "job": "sysid",
        "world": {"size": [0.2, 0.1], "dx": 0.01, "gravity": [0.0, -9.81], "frame": "updated"},
        "bodies": {"a": body([0.02, 0.05], groups=groups), "b": body([0.1, 0.05])},
        "boundaries": {"clamp": {"sticky": {"region": {"box": {"corner": [0.0, 0.0], "size": [0.03, 0.1]}}}}},
        "time": {"duration": DURATION, "control_step": 0.01, "substeps": 10},
        "data": {"synthetic": synthetic},
        "unknowns": unknowns,
        "optimizer": {"least_squares": {"max_iterations": 15}},
    }
    return scene | more


def write_run(out: Path, scene: dict, *, name: str = "twin/0123456789ab", job: str = "sysid", status: str) -> Path:
    """Write the files that every run has, and return its directory."""
    run = out / name
    run.mkdir(parents=True)
    (run / "scene.yaml").write_text(dump(resolve(load_scene(scene))))
    (run / "run.json").write_text(json.dumps({"status": status, "seconds": 10.0, "job": job, "base": str(out)}))
    return run


def write_history(run: Path, columns: dict[str, Array]) -> None:
    with (run / "history.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(columns)
        for row in zip(*columns.values(), strict=True):
            table.writerow([int(row[0]), *(float(value) for value in row[1:])])


def history(rows: int, unknowns: dict[str, Array | None]) -> dict[str, Array]:
    """Return a history with falling loss; each unknown has values (rows, n), or None for only its gradient."""
    k = np.arange(rows, dtype=float)
    columns = {"iteration": k, "loss": 4e-6 * 0.25**k + 1e-8}
    columns |= {f"grad:{path}": 1e-5 * 0.5**k for path in unknowns}
    for path, values in unknowns.items():
        if values is None:
            continue
        values = np.reshape(values, (rows, -1))
        labels = [f"value:{path}[{i}]" for i in range(values.shape[1])] if values.shape[1] > 1 else [f"value:{path}"]
        columns |= dict(zip(labels, values.T, strict=True))
    return columns | {"seconds": 3.0 + 2.0 * k}


def write_result(run: Path, unknowns: dict[str, dict], recordings: dict | None) -> None:
    result = {"job": "sysid", "status": "converged", "message": "", "loss": None, "iterations": 5}
    result["unknowns"] = {path: {"initial": entry["value"], **entry} for path, entry in unknowns.items()}
    result["recordings"] = recordings and {name: {"rmse_mm": None, **entry} for name, entry in recordings.items()}
    (run / "result.json").write_text(json.dumps(result))


def write_tracks(run: Path, recordings: dict[str, tuple[tuple[str, ...], Array, Array, Array]]) -> None:
    """Write tracks.csv of recording -> marker names, time (T,), data (T, M, D), model (T, M, D)."""
    with (run / "tracks.csv").open("w", newline="") as file:
        table = csv.writer(file)
        dim = next(iter(recordings.values()))[2].shape[2]
        axes = "xyz"[:dim]
        table.writerow(["recording", "marker", "time", *(f"data_{a}" for a in axes), *(f"model_{a}" for a in axes)])
        for name, (markers, time, data, model) in recordings.items():
            for m, marker in enumerate(markers):
                for f, t in enumerate(time):
                    table.writerow([name, marker, float(t), *data[f, m].tolist(), *model[f, m].tolist()])


def write_trajectory(
    run: Path, x: Array, time: Array, bodies: dict[str, slice] | None = None, provenance: dict | None = None
) -> None:
    """Write trajectory.h5 with positions (T, N, D) and attributes."""
    slices = bodies or {"a": slice(0, x.shape[1])}
    with TrajectoryWriter(run / "trajectory.h5", len(time), slices, x.shape[2], {}, provenance or {}) as writer:
        for frame, t in enumerate(time):
            writer.write(frame, float(t), x=x[frame])


def swing(rng: np.random.Generator, markers: int, dim: int, noise: float = 0.0) -> tuple[Array, Array, Array]:
    """Return time (T,), data and model (T, M, D) of points that swing along the last axis, each with more amplitude."""
    time = np.arange(0.0, DURATION + 1e-9, 0.01)
    rest = rng.uniform(0.02, 0.07, (markers, dim))
    reach = np.linspace(1e-4, 1e-2, markers)
    model = np.broadcast_to(rest, (len(time), markers, dim)).copy()
    model[:, :, -1] -= reach * (1.0 - np.cos(2 * np.pi * time / 0.15))[:, None]
    return time, model + noise * rng.standard_normal(model.shape), model


def made_twin(out: Path, rng: np.random.Generator, *, name: str = "twin/0123456789ab") -> Path:
    """Return a converged run with all files that a run can have, one unknown and two markers."""
    path = f"bodies.a.{YOUNG}"
    run = write_run(out, plane_scene({path: {"bounds": [1e5, 5e5], "scale": "log"}}), name=name, status="converged")
    values = 3e5 - 1e5 * 0.3 ** np.arange(6)
    write_history(run, history(6, {path: values}))
    write_result(
        run,
        {path: {"initial": 2e5, "value": float(values[-1]), "interval": [2.9e5, 3.1e5]}},
        {"synthetic": {"holdout": False, "rmse_mm": 0.28}},
    )
    time, data, model = swing(rng, 2, 2, 2e-4)
    write_tracks(run, {"synthetic": (("near", "far"), time, data, model)})
    write_trajectory(run, model, time)
    return run
