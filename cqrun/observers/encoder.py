"""A small convolutional encoder in NumPy, and its adjoint.

Layers of 3^D kernels with stride 2, each followed by ELU, then a linear map to the latent numbers. `vae_training.py`
trains the encoder with torch; to run it, NumPy is enough.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cqrun.plugin.contract import Array

KERNEL, STRIDE = 3, 2


@dataclass(frozen=True)
class Encoder:
    """Weights of the encoder.

    Attributes:
        kernels: (C_out, C_in, 3, ...) for each layer, in torch's layout.
        offsets: (C_out,) bias of each layer.
        weights, shift: (k, n) and (k,) matrix and bias of the linear map.
        middle: (C,) mean of each channel, which is subtracted from an image first.
    """

    kernels: tuple[Array, ...]
    offsets: tuple[Array, ...]
    weights: Array
    shift: Array
    middle: Array

    def takes(self, shape: Sequence[int]) -> bool:
        """Return whether the shapes of all arrays fit each other and an image of a shape (C, G, ...)."""
        channels, *cells = shape
        if self.middle.shape != (channels,):
            return False
        for kernel, offset in zip(self.kernels, self.offsets, strict=True):
            if kernel.shape[1:] != (channels, *(KERNEL,) * len(cells)) or offset.shape != kernel.shape[:1]:
                return False
            channels, cells = len(kernel), [size_after(n) for n in cells]
        return self.shift.ndim == 1 and self.weights.shape == (len(self.shift), channels * math.prod(cells))

    def encode(self, image: Array) -> Array:
        """Return the latent numbers (k,) of an image (C, G, ...)."""
        return self.weights @ self._layers(image)[-1].reshape(-1) + self.shift

    def encode_vjp(self, image: Array, z_bar: Array) -> Array:
        """Return the cotangent of the image (C, G, ...) from that of the latent numbers (k,)."""
        layers = self._layers(image)
        bar = (self.weights.T @ z_bar).reshape(layers[-1].shape)
        for kernel, before, after in reversed(list(zip(self.kernels, layers[:-1], layers[1:], strict=True))):
            bar = convolved_vjp(kernel, before.shape, bar * elu_slope(after))
        return bar

    def _layers(self, image: Array) -> list[Array]:
        each = (-1, *(1,) * (image.ndim - 1))
        layers = [image - self.middle.reshape(each)]
        for kernel, offset in zip(self.kernels, self.offsets, strict=True):
            layers.append(elu(convolved(kernel, layers[-1]) + offset.reshape(each)))
        return layers


def elu(a: Array) -> Array:
    """Return ELU(a): a where it is positive, exp(a) - 1 elsewhere. Its derivative is continuous."""
    return np.where(a.real > 0, a, np.expm1(np.where(a.real > 0, 0.0, a)))


def elu_slope(out: Array) -> Array:
    """Return the derivative of `elu`, given its result."""
    return np.where(out > 0, 1.0, out + 1.0)


def size_after(cells: int) -> int:
    """Return the number of cells along an axis that a layer gives from `cells`."""
    return (cells + 1) // STRIDE


def convolved(kernel: Array, image: Array) -> Array:
    """Return the cross-correlation of an image (C, G, ...), padded by one cell, with a kernel, at stride 2."""
    return np.tensordot(kernel.reshape(len(kernel), -1), _columns(image), axes=1)


def convolved_vjp(kernel: Array, shape: Sequence[int], out_bar: Array) -> Array:
    """Return the cotangent of the image, which has shape `shape`, from that of `convolved`."""
    dim = len(shape) - 1
    bars = np.tensordot(kernel.reshape(len(kernel), -1).T, out_bar, axes=1)
    bars = bars.reshape(shape[0], *(KERNEL,) * dim, *out_bar.shape[1:])
    padded = np.zeros((shape[0], *(n + 2 for n in shape[1:])))
    for offset in itertools.product(range(KERNEL), repeat=dim):
        at: tuple[int | slice, ...] = (slice(None), *offset)
        padded[_places(offset, out_bar.shape[1:])] += bars[at]
    return padded[(slice(None), *(slice(1, -1),) * dim)]


def _columns(image: Array) -> Array:
    """Return the image's values under the kernel at each output cell (C * 3^D, G', ...)."""
    dim = image.ndim - 1
    padded = np.pad(image, [(0, 0), *[(1, 1)] * dim])
    out = tuple(size_after(n) for n in image.shape[1:])
    patches = [padded[_places(offset, out)] for offset in itertools.product(range(KERNEL), repeat=dim)]
    return np.stack(patches, axis=1).reshape(-1, *out)


def _places(offset: Sequence[int], out: Sequence[int]) -> tuple[slice, ...]:
    """Return the index of the padded cells at one offset of the kernel, for all output cells."""
    return (slice(None), *(slice(o, o + STRIDE * (n - 1) + 1, STRIDE) for o, n in zip(offset, out, strict=True)))
