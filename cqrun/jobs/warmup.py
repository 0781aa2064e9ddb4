"""`cqrun warmup`: compile kernels before they are needed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from cqrun.build.model import build
from cqrun.running.kernels import compile_kernels, composition
from cqrun.running.reporter import Reporter, Silent
from cqrun.scene.load import load_scene
from cqrun.scene.schema import Scene

ELASTIC = {"youngs_modulus": 1e4, "poissons_ratio": 0.3}


def warmup(scenes: Sequence[Path] = (), *, reporter: Reporter | None = None) -> Iterator[str]:
    """Compile the kernels of scenes, or the common ones, forward and backward; yield the time of each.

    Args:
        scenes: scene files; if empty, bodies of both elastic laws with and without viscosity, clamped or on a floor, in
            2D and 3D and both frames.

    Raises:
        SceneError: a scene cannot be run.
    """
    talk = reporter or Silent()
    for scene in [load_scene(path) for path in scenes] if scenes else common_scenes():
        built = build(scene)
        seconds = compile_kernels([built], talk, adjoint=True)
        yield f"{seconds:5.1f} s  {composition(built, adjoint=True)}"


def common_scenes() -> Iterator[Scene]:
    """Yield small scenes that together need the kernels of most scenes."""
    viscosities: tuple[dict[str, Any], ...] = ({}, {"viscosity": {"shear": 1.0}})
    floor = {"friction": {"face": "y_min", "coefficient": 0.3}}
    for frame, dim in product(("reference", "updated"), (2, 3)):
        for law, viscosity, boundary in product(("fixed_corotated", "neo_hookean"), viscosities, (_clamp(dim), floor)):
            material = {"density": 1000.0, "elastic": {law: ELASTIC}, **viscosity}
            yield load_scene(_scene(frame, dim, material, boundary))


def _clamp(dim: int) -> dict[str, Any]:
    return {"sticky": {"region": {"box": {"corner": [0.0] * dim, "size": [0.02] + [0.1] * (dim - 1)}}}}


def _scene(frame: str, dim: int, material: dict[str, Any], boundary: dict[str, Any]) -> dict[str, Any]:
    return {
        "cqrun": 1,
        "world": {"size": [0.1] * dim, "dx": 0.01, "frame": frame},
        "bodies": {
            "block": {
                "shape": {"box": {"corner": [0.02] * dim, "size": [0.04] * dim}},
                "particles_per_cell": 2**dim,
                "material": material,
            }
        },
        "boundaries": {"held": boundary},
        "time": {"duration": 0.01, "control_step": 0.01},
    }
