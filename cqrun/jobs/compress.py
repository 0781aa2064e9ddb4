"""`cqrun compress`: learn to describe a body's shape in few numbers, for the observers `pca` and `vae`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from cqrun.errors import UsageError
from cqrun.explain import listed, suggest
from cqrun.memory import shortage
from cqrun.observers.pca import fit_components, save_components
from cqrun.observers.raster import Raster
from cqrun.observers.vae import MOST_CELLS, Trained, save_encoder
from cqrun.observers.vae_training import Training, library
from cqrun.plugin.contract import Array
from cqrun.running.reporter import Reporter, Silent
from cqrun.store.atomic import disk_errors, make_directory, require_room, write_bytes
from cqrun.store.frames import Frames

EDGE = 1.2
"""Edge of the grid of cells divided by the largest extent of the body in the runs."""

DOUBLE = 8
"""Size of a float64 [bytes]."""

KEEP_EVERY = 20.0
"""Time between two saved states of a training [s]."""


def compress(
    runs: Sequence[Path], method: Literal["pca", "vae"], size: int, output: Path, *, body: str | None = None,
    cells: int = 16, epochs: int = 200, seed: int = 0, reporter: Reporter | None = None,
) -> str:  # fmt: skip
    """Fit an observer to the trajectories of runs, write its file, and return how much it explains as text.

    The state of an autoencoder's training is saved beside its file until that is written: the same call continues it.

    Args:
        runs: run directories with a trajectory.h5 of the same body.
        method: principal components, or an autoencoder (extra `torch`).
        size: number of numbers.
        output: the file, for `pca: {file: ...}` or `vae: {file: ...}`.
        body: name of the body; the only one if not given.
        cells: number of cells along each axis of the autoencoder's grid.

    Raises:
        UsageError: a run has no trajectory, or another body, or the body does not move; the file cannot be written.
        MissingExtra: torch is missing. Stopped: asked to stop.
    """
    talk = reporter or Silent()
    check_place(output)
    if method == "vae":
        library()
    frames = [read(run, body) for run in runs]
    sizes = {x.shape[1:] for x, _ in frames}
    if len(sizes) > 1:
        bodies = listed([f"{n} particles in {dim}D" for n, dim in sorted(sizes)])
        raise UsageError(f"the runs are of different bodies: {bodies}; give runs of one body")
    if method == "pca":
        lengths = [len(x) for x, _ in frames]
        starts = np.cumsum([0, *lengths[:-1]]).tolist()
        components = fit_components(np.concatenate([x for x, _ in frames]), size, starts)
        with disk_errors(output):
            save_components(output, components)
        return f"{size} components explain {components.explained.sum():.1%} of the variance"
    x, v = (np.concatenate(parts) for parts in zip(*frames, strict=True))
    raster = raster_of(x, v, cells)
    require_memory(len(x), raster, size)
    training = Training(np.stack([raster.image(*frame) for frame in zip(x, v, strict=True)]), size, seed=seed)
    learn(training, epochs, output.with_name(f"{output.name}.training"), talk)
    with disk_errors(output):
        save_encoder(output, Trained(raster, training.encoder()))
    output.with_name(f"{output.name}.training").unlink(missing_ok=True)
    return f"a code of {size} numbers explains {1.0 - training.error:.1%} of the variance of {len(x)} images"


def check_place(output: Path) -> None:
    """Raise an error before any work if the file cannot be written."""
    if output.is_dir():
        raise UsageError(f"{output}: is a directory; --out needs the name of a file, such as {output / 'encoder.npz'}")
    make_directory(output.parent)
    require_room(output, 0)


def learn(training: Training, epochs: int, kept: Path, talk: Reporter) -> None:
    """Train for the remaining epochs; save the state regularly, and when asked to stop."""
    if kept.exists() and not training.restore(kept.read_bytes(), epochs):
        talk.warn(f"{kept}: is the state of another training (other runs, options or torch): training starts again")
    talk.begin(epochs)
    with talk.stop.deferred():
        _train(training, epochs, kept, talk)


def _train(training: Training, epochs: int, kept: Path, talk: Reporter) -> None:
    last = time.monotonic()
    while training.epochs < epochs:
        training.epoch()
        talk.advance(training.epochs, epochs, f"epoch {training.epochs}, error {training.error:.4f}")
        if talk.stop.asked or time.monotonic() - last > KEEP_EVERY:
            write_bytes(kept, training.state())
            last = time.monotonic()
        if talk.stop.asked and training.epochs < epochs:
            raise talk.stop.stopped(f"stopped after epoch {training.epochs} of {epochs}; the same command continues")


def read(run: Path, body: str | None) -> tuple[Array, Array]:
    """Return positions and velocities (T, N, D) of a body in a run's trajectory."""
    with Frames(run / "trajectory.h5") as frames:
        name = next(iter(frames.bodies)) if body is None and len(frames.bodies) == 1 else body
        if name is None:
            raise UsageError(f"{run}: name the body with --body; there are: {listed(frames.bodies)}")
        if name not in frames.bodies:
            near = suggest(name, frames.bodies)
            raise UsageError(f"{run}: no body is called '{name}'{near}; there are: {listed(frames.bodies)}")
        part = frames.bodies[name]
        return tuple(frames.read_all(field)[:, part].astype(float) for field in ("x", "v"))  # type: ignore[return-value]


def require_memory(count: int, raster: Raster, size: int) -> None:
    """Raise a UsageError if the images of all frames, or the weights of a code, need more memory than is free."""
    pixels = (1.0 + raster.dim) * float(raster.cells) ** raster.dim
    for what, need, advice in (
        (f"{count:,} images of {raster.cells}^{raster.dim} cells need", DOUBLE * count * pixels, "give fewer --cells"),
        (f"a code of {size:.3g} numbers needs", DOUBLE * size * pixels, "give a smaller --size"),
    ):
        if lack := shortage(what, need, advice):
            raise UsageError(lack)


def raster_of(x: Array, v: Array, cells: int) -> Raster:
    """Return a grid that contains the body in all frames; speeds are in units of their root mean square."""
    if cells > MOST_CELLS:
        raise UsageError(f"{cells:,} cells along each axis of the grid are too many; give at most {MOST_CELLS}")
    centred = x - x.mean(axis=1, keepdims=True)
    speed = float(np.sqrt((v**2).mean()))
    if not speed > 0:
        raise UsageError("the body does not move in these runs: there is nothing to learn from them")
    return Raster(cells, EDGE * 2.0 * float(np.abs(centred).max()) / cells, speed, x.shape[2])
