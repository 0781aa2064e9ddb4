"""A body's shape and motion in few numbers: the mean of a variational autoencoder's code (CQ2, appendix C)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import Field

from cqrun.errors import UsageError
from cqrun.observers.encoder import Encoder
from cqrun.observers.matter import Matter
from cqrun.observers.npz import read_arrays, write_arrays
from cqrun.observers.observer import BoundObserver, Moment, MomentBar, Observer
from cqrun.observers.ranges import Range, limits
from cqrun.observers.raster import Raster
from cqrun.observers.rows import weighted
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import BodyName, FileName
from cqrun.plugin.registry import plugin
from cqrun.state import State

WHAT = "file of a trained encoder"
USUAL = 3.0
"""Codes are trained towards a normal distribution of standard deviation 1: few lie beyond this."""


@dataclass(frozen=True)
class Trained:
    """An encoder with the grid of cells that it looks at."""

    raster: Raster
    encoder: Encoder


@plugin("observer", "vae")
class Vae(Observer):
    """The code [1] that a convolutional variational autoencoder has for a body on a grid that travels with it.

    The encoder is trained on trajectories (`cqrun compress`) and comes from a file; the gradient goes through it.
    A. Spielberg, A. Zhao, T. Du, Y. Hu, D. Rus, W. Matusik: Learning-in-the-loop optimization, NeurIPS 2019.
    """

    body: BodyName = Field(description="Body that is observed")
    file: FileName = Field(description="File (.npz) of the encoder, from `cqrun compress`")
    range: Range = Field(description="[low, high] that becomes [-1, 1]; auto: -3 to 3, or null", default="auto")

    def bind(self, matter: Matter) -> BoundObserver:
        return self.bind_to(matter, load_encoder(self.path_of(self.file)))

    def bind_to(self, matter: Matter, trained: Trained) -> BoundObserver:
        """Return this observer with a trained encoder; UsageError where it is of another dimension."""
        if trained.raster.dim != matter.dim:
            raise UsageError(f"the encoder is of a {trained.raster.dim}D body; '{self.body}' is in {matter.dim}D")
        return LatentCode(self, matter, trained)


class LatentCode(BoundObserver):
    """z = encode(image(x, v))."""

    needs_state = True

    def __init__(self, spec: Vae, matter: Matter, trained: Trained) -> None:
        self.members, self.trained = matter.members(spec.body), trained
        self.size = len(trained.encoder.shift)
        self.rows = weighted([], [], matter.n_particles)
        self.low, self.high = limits(spec.range, np.full(self.size, -USUAL), np.full(self.size, USUAL))

    def observe(self, moment: Moment) -> tuple[Array, Array]:
        state = moment.state()
        image = self.trained.raster.image(state.x[self.members], state.v[self.members])
        return self.trained.encoder.encode(image), np.zeros(0)

    def observe_vjp(self, moment: Moment, z_bar: Array, memory_next_bar: Array) -> MomentBar:
        state = moment.state()
        x, v = state.x[self.members], state.v[self.members]
        image_bar = self.trained.encoder.encode_vjp(self.trained.raster.image(x, v), z_bar)
        bar = State(*(np.zeros_like(a) for a in (state.x, state.v, state.C, state.F)))
        bar.x[self.members], bar.v[self.members] = self.trained.raster.image_vjp(x, v, image_bar)
        return MomentBar(state=bar)


def save_encoder(path: Path, trained: Trained) -> None:
    """Write an encoder for `vae: {file: ...}`; OSError where the disk refuses."""
    raster, encoder = trained.raster, trained.encoder
    layers = {f"kernel{k}": a for k, a in enumerate(encoder.kernels)}
    layers |= {f"offset{k}": a for k, a in enumerate(encoder.offsets)}
    grid = np.array([raster.cells, raster.cell, raster.speed, raster.dim], float)
    own = {"weights": encoder.weights, "shift": encoder.shift, "middle": encoder.middle}
    write_arrays(path, {"grid": grid, **own, **layers})


def load_encoder(path: Path) -> Trained:
    """Read an encoder; UsageError where the file is none."""
    arrays = read_arrays(path, WHAT)
    depth = sum(name.startswith("kernel") for name in arrays)
    layers = [f"{part}{k}" for part in ("kernel", "offset") for k in range(depth)]
    names = ["grid", "weights", "shift", "middle", *layers]
    if sorted(names) != sorted(arrays) or arrays["grid"].shape != (4,):
        raise UsageError(f"{path}: is no {WHAT}: it must hold the arrays {', '.join(names)}")
    cells, cell, speed, dim = (float(a) for a in arrays["grid"])
    kernels, offsets = (tuple(arrays[f"{part}{k}"] for k in range(depth)) for part in ("kernel", "offset"))
    encoder = Encoder(kernels, offsets, *(arrays[name] for name in ("weights", "shift", "middle")))
    return Trained(Raster(int(cells), cell, speed, int(dim)), encoder)
