"""`cqrun compress`: learn from runs how a body deforms, in few numbers, for the observers `pca` and `vae`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from cqrun.contract import Array
from cqrun.errors import UsageError
from cqrun.explain import listed, suggest
from cqrun.jobs.reporter import Reporter, Silent
from cqrun.observers.pca import fit_components, save_components
from cqrun.observers.raster import Raster
from cqrun.observers.vae import Trained, save_encoder
from cqrun.observers.vae_training import train
from cqrun.store.atomic import disk_errors
from cqrun.store.frames import Frames

EDGE = 1.2
"""The grid of cells over the greatest extent of the body that was seen."""


def compress(
    runs: Sequence[Path], method: Literal["pca", "vae"], size: int, output: Path, *, body: str | None = None,
    cells: int = 16, epochs: int = 200, seed: int = 0, reporter: Reporter | None = None,
) -> str:  # fmt: skip
    """Fit an observer to the trajectories of runs, write its file, and say how much it explains.

    Args:
        runs: run directories with a trajectory.h5, of the same body.
        method: principal components, or an autoencoder (extra `torch`).
        size: how many numbers.
        output: the file, for `pca: {file: ...}` or `vae: {file: ...}`.
        body: whose; the only one if not given.
        cells: along each axis of the autoencoder's grid.

    Raises:
        UsageError: a run without trajectory, of another body, or one that does not move. MissingExtra: no torch.
    """
    talk = reporter or Silent()
    frames = [read(run, body) for run in runs]
    sizes = {x.shape[1:] for x, _ in frames}
    if len(sizes) > 1:
        told = listed([f"{n} particles in {dim}D" for n, dim in sorted(sizes)])
        raise UsageError(f"the runs are of different bodies: {told}; give runs of one body")
    if method == "pca":
        found = fit_components(np.concatenate([x for x, _ in frames]), size)
        with disk_errors(output):
            save_components(output, found)
        return f"{size} components explain {found.explained.sum():.1%} of the variance"
    x, v = (np.concatenate(parts) for parts in zip(*frames, strict=True))
    raster = raster_of(x, v, cells)
    images = np.stack([raster.image(*frame) for frame in zip(x, v, strict=True)])
    talk.begin(epochs)
    encoder, error = train(
        images, size, epochs=epochs, seed=seed,
        progress=lambda epoch, error: talk.advance(epoch, epochs, f"epoch {epoch}, error {error:.4f}"),
    )  # fmt: skip
    with disk_errors(output):
        save_encoder(output, Trained(raster, encoder))
    return f"a code of {size} numbers explains {1.0 - error:.1%} of the variance of {len(images)} images"


def read(run: Path, body: str | None) -> tuple[Array, Array]:
    """Return positions and velocities (T, N, D) of a body in a run's trajectory."""
    with Frames(run / "trajectory.h5") as frames:
        name = next(iter(frames.bodies)) if body is None and len(frames.bodies) == 1 else body
        if name not in frames.bodies:
            near = suggest(name, frames.bodies) if name else ""
            raise UsageError(f"{run}: say whose motion with --body{near}; there are: {listed(frames.bodies)}")
        part = frames.bodies[name]
        return tuple(frames.read_all(field)[:, part].astype(float) for field in ("x", "v"))  # type: ignore[return-value]


def raster_of(x: Array, v: Array, cells: int) -> Raster:
    """Return the grid that holds a body however it was seen; speeds in units of their root mean square."""
    centred = x - x.mean(axis=1, keepdims=True)
    speed = float(np.sqrt((v**2).mean()))
    if not speed > 0:
        raise UsageError("the body does not move in these runs: there is nothing to learn of its motion")
    return Raster(cells, EDGE * 2.0 * float(np.abs(centred).max()) / cells, speed, x.shape[2])
