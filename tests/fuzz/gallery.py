"""Small scenes that have every part of the schema between them: with the shipped ones, what the fuzzer mutates."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
from made_encoders import made_encoder
from PIL import Image

from cqrun.observers.pca import fit_components, save_components
from cqrun.observers.vae import save_encoder

SCENES = {path.stem: path.read_text() for path in sorted((Path(__file__).parent / "scenes").glob("*.yaml"))}

CONTROLLERS = (
    "{linear_tanh: {gain: 0.9, spread: 0.1}}", "{open_loop: {every: 3, initial: 0.2, noise: 0.1}}",
    "{given: {knots: [[0, 0, 0.5, 0.5, 0, 0], [1, -1, 1, 1, 0.5, 0]], every: 2, interpolate: linear}}",
)  # fmt: skip
OPTIMIZERS = {
    "plane": (
        "{adam: {learning_rate: 0.01, decay: 0.1, batch_size: 2, clip: 1, mask: 0.1, beta1: 0.8, epsilon: 1.0e-8}}",
        "{sgd: {learning_rate: 0.01, momentum: 0.5, clip_entries: 1, gradient_tolerance: 1.0e-9}}",
        "{cma_es: {population: 6, sigma: 0.2, function_tolerance: 1.0e-9, step_tolerance: 1.0e-9}}",
    ),
    "solid": (
        "{nlopt: {max_iterations: 5, function_tolerance: 1.0e-9, constraint_tolerance: 1.0e-5}}",
        "{slsqp: {max_iterations: 5, function_tolerance: 1.0e-9}}",
        "{trust_constr: {max_iterations: 5, gradient_tolerance: 1.0e-5, step_tolerance: 1.0e-7}}",
    ),
    "fit": ("{least_squares: {max_iterations: 5, function_tolerance: 1.0e-7, gradient_tolerance: 1.0e-7}}",),
}
"""By the scene in which each takes the optimizer's place; those of the plane take no constraints."""


def write_gallery(folder: Path) -> list[Path]:
    """Write the scenes and the files that they name to a folder, and return the scenes' paths."""
    _write_files(folder)
    texts = dict(SCENES)
    for k, controller in enumerate(CONTROLLERS):
        texts[f"plane_controller{k}"] = _with(SCENES["plane"], "controller", controller)
    for of, optimizers in OPTIMIZERS.items():
        for k, optimizer in enumerate(optimizers):
            text = _with(SCENES[of], "optimizer", optimizer)
            texts[f"{of}_optimizer{k}"] = _with(text, "constraints", "{}") if of == "plane" else text
    paths = [folder / f"{name}.yaml" for name in texts]
    for path, text in zip(paths, texts.values(), strict=True):
        path.write_text(text)
    return paths


def _with(text: str, section: str, value: str) -> str:
    """Return a scene with another value of a section."""
    return re.sub(rf"(?m)^{section}:.*\n(?: .*\n)*", f"{section}: {value}\n", text)


def _write_files(folder: Path) -> None:
    rng = np.random.default_rng(7)
    pixels = np.full((12, 18, 3), 255, np.uint8)
    pixels[2:10, 2:16] = (0, 0, 255)
    pixels[4:8, 4:8] = (255, 0, 0)
    Image.fromarray(pixels).save(folder / "body.png")
    save_components(folder / "pca.npz", fit_components(rng.normal(size=(5, 60, 2)), 2))
    save_encoder(folder / "vae.npz", made_encoder(2, rng))
    with (folder / "marks.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["time", "marker", "x", "y"])
        for k in range(20):
            table.writerow([0.01 * k, "tip", 0.119, 0.065 - 0.0001 * k])
            table.writerow([0.01 * k, "mid", 0.08, 0.065])
    for name, head in (("forces", "clamp_mN"), ("moments", "clamp_Nmm")):
        with (folder / f"{name}.csv").open("w", newline="") as file:
            csv.writer(file).writerows([["upper_N", head], [0.0, 23.5], [30.0, 23.6], [60.0, 23.4]])
    with (folder / "poses.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["pose", "upper_N", "note", "marker", "x", "y"])
        table.writerow(["hanging", 0.0, "a", "tip", 0.1387, 0.0575])
        table.writerow(["up", 60.0, "b", "tip", 0.1381, 0.0622])
    (folder / "force.csv").write_text("travel_mm,force_mN,note\n0,0,a\n1,20,b\n2,-30,c\n")
    (folder / "motion.csv").write_text('time_ms,cell_mN,note\n0,0,a\n10,20,b\n20,30,c\n40,10,d\n60,"",e\n')
    (folder / "moment.csv").write_text("upper_N,moment_Nmm\n0,900\n60,1200\n")
