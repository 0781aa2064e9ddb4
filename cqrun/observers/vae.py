"""A body's shape and motion in few numbers: the mean of a variational autoencoder's code (CQ2, appendix C)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydantic import Field

from cqrun.errors import UsageError
from cqrun.observers.encoder import Encoder
from cqrun.observers.matter import Matter
from cqrun.observers.npz import not_numbers, read_arrays, write_arrays
from cqrun.observers.observer import BoundObserver, Moment, MomentBar, Observer
from cqrun.observers.ranges import Range, limits
from cqrun.observers.raster import Raster
from cqrun.observers.rows import weighted
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import BodyName, FileName
from cqrun.plugin.registry import plugin

FILE_KIND = "an encoder file"
MOST_CELLS = 256
"""Largest number of cells along each axis of the grid; an image of so many has 67 million numbers in 3D."""

TYPICAL_CODE = 3.0
"""Training draws codes towards a normal distribution with standard deviation 1, so few are larger than this."""


@dataclass(frozen=True)
class Trained:
    """An encoder with the grid of cells whose image it encodes."""

    raster: Raster
    encoder: Encoder


@plugin("observer", "vae")
class Vae(Observer):
    """The code [1] that a convolutional variational autoencoder gives for a body on a grid that moves with it.

    `cqrun compress` trains the encoder on trajectories and writes it to a file. Gradients go through the encoder.
    A. Spielberg, A. Zhao, T. Du, Y. Hu, D. Rus, W. Matusik: Learning-in-the-loop optimization, NeurIPS 2019.
    """

    body: BodyName = Field(description="Body that is observed")
    file: FileName = Field(description="File (.npz) of the encoder, from `cqrun compress`")
    range: Range = Field(description="[low, high] that is scaled to [-1, 1]; auto: -3 to 3; or null", default="auto")

    def bind(self, matter: Matter) -> BoundObserver:
        return self.bind_to(matter, load_encoder(self.path_of(self.file)))

    def bind_to(self, matter: Matter, trained: Trained) -> BoundObserver:
        """Bind this observer with a trained encoder; UsageError if that has another dimension than the scene."""
        if trained.raster.dim != matter.dim:
            raise UsageError(
                f"the encoder was trained on a {trained.raster.dim}D body; '{self.body}' is in {matter.dim}D"
            )
        return LatentCode(self, matter, trained)


class LatentCode(BoundObserver):
    """z = encode(image(x, v))."""

    needs_state = True

    def __init__(self, spec: Vae, matter: Matter, trained: Trained) -> None:
        self.members, self.trained = matter.members(spec.body), trained
        self.size = len(trained.encoder.shift)
        self.rows = weighted([], [], matter.n_particles)
        self.low, self.high = limits(spec.range, np.full(self.size, -TYPICAL_CODE), np.full(self.size, TYPICAL_CODE))

    def observe(self, moment: Moment) -> tuple[Array, Array]:
        state = moment.state()
        image = self.trained.raster.image(state.x[self.members], state.v[self.members])
        return self.trained.encoder.encode(image), np.zeros(0)

    def observe_vjp(self, moment: Moment, z_bar: Array, memory_next_bar: Array) -> MomentBar:
        state = moment.state()
        x, v = state.x[self.members], state.v[self.members]
        image_bar = self.trained.encoder.encode_vjp(self.trained.raster.image(x, v), z_bar)
        bar = replace(state.zeros_like(), memory=np.zeros(0))
        bar.x[self.members], bar.v[self.members] = self.trained.raster.image_vjp(x, v, image_bar)
        return MomentBar(state=bar)


def save_encoder(path: Path, trained: Trained) -> None:
    """Write an encoder for `vae: {file: ...}`; OSError if that fails."""
    raster, encoder = trained.raster, trained.encoder
    layers = {f"kernel{k}": a for k, a in enumerate(encoder.kernels)}
    layers |= {f"offset{k}": a for k, a in enumerate(encoder.offsets)}
    grid = np.array([raster.cells, raster.cell, raster.speed, raster.dim], float)
    linear = {"weights": encoder.weights, "shift": encoder.shift, "middle": encoder.middle}
    write_arrays(path, {"grid": grid, **linear, **layers})


def load_encoder(path: Path) -> Trained:
    """Read an encoder; UsageError if the file contains none."""
    arrays = read_arrays(path, FILE_KIND)
    depth = sum(name.startswith("kernel") for name in arrays)
    layers = [f"{part}{k}" for part in ("kernel", "offset") for k in range(depth)]
    names = ["grid", "weights", "shift", "middle", *layers]
    if sorted(names) != sorted(arrays) or arrays["grid"].shape != (4,):
        raise UsageError(f"{path}: is not {FILE_KIND}: it must contain the arrays {', '.join(names)}")
    if bad := not_numbers(arrays):
        raise UsageError(f"{path}: {', '.join(bad)} of the encoder are not finite numbers")
    cells, cell, speed, dim = (float(a) for a in arrays["grid"])
    if not (1 <= cells <= MOST_CELLS and dim in (2, 3) and cell > 0 and speed > 0):
        raise UsageError(
            f"{path}: is not {FILE_KIND}: its grid {arrays['grid'].tolist()} cannot be one; train it again"
        )
    kernels, offsets = (tuple(arrays[f"{part}{k}"] for k in range(depth)) for part in ("kernel", "offset"))
    encoder = Encoder(kernels, offsets, *(arrays[name] for name in ("weights", "shift", "middle")))
    trained = Trained(Raster(int(cells), cell, speed, int(dim)), encoder)
    if not encoder.takes(trained.raster.shape):
        raise UsageError(f"{path}: is not {FILE_KIND}: the shapes of its arrays do not fit each other; train it again")
    return trained
