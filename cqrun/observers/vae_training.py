"""Training of the autoencoder whose code the observer `vae` gives (extra `torch`; a CPU is enough).

    z = mu + sigma noise,   loss = mean |decode(z) - image|^2 + beta KL(N(mu, sigma) | N(0, 1)),

with images scaled by each channel's standard deviation (D. P. Kingma, M. Welling: Auto-encoding variational Bayes, ICLR
2014). Only the encoder of the mean mu is saved, as arrays; `encoder.py` runs it without torch.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from cqrun.errors import MissingExtra
from cqrun.observers.encoder import KERNEL, STRIDE, Encoder, size_after
from cqrun.plugin.contract import Array

CHANNELS = (16, 32)
"""Channels of the layers."""

SAME = 1e-12
"""A channel whose spread is less than this part of the images' largest number is constant, and is not scaled."""


def library() -> Any:
    """Return the module `torch`.

    Raises:
        MissingExtra: it is not installed.
    """
    try:
        import torch
    except ImportError as error:
        raise MissingExtra(
            "training an autoencoder needs the package 'torch', which is not installed: pip install 'cqrun[torch]' "
            "(several GB; install its CPU build first to avoid that)"
        ) from error
    return torch


class Training:
    """Training on images (T, C, G, ...) for codes of `size` numbers, one epoch at a time.

    On one machine the same seed gives bit-for-bit identical results, also with `state` and `restore` between epochs.

    Args:
        batch, learning_rate: batch size and learning rate of Adam.
        beta: weight of the KL divergence.

    Attributes:
        epochs: number of epochs so far.
        error: share of the images' variance that the code did not explain in the last epoch.

    Raises:
        MissingExtra: torch is not installed.
    """

    def __init__(
        self, images: Array, size: int, *, batch: int = 64, learning_rate: float = 1e-3, beta: float = 1e-3,
        seed: int = 0,
    ) -> None:  # fmt: skip
        self.torch = torch = library()
        torch.manual_seed(seed)
        axes = (0, *range(2, images.ndim))
        self.middle = images.mean(axis=axes, keepdims=True)
        spread = images.std(axis=axes, keepdims=True)
        self.spread = np.where(spread > SAME * np.abs(images).max(), spread, 1.0)
        self.data = torch.tensor((images - self.middle) / self.spread, dtype=torch.float32)
        self.net = _network(torch, self.data.shape[1:], size)
        self.optimizer = torch.optim.Adam(self.net.parameters(), lr=learning_rate)
        self.generator = torch.Generator().manual_seed(seed)
        self.batch, self.beta, self.epochs, self.error = batch, beta, 0, np.inf
        shape = f"{self.data.shape} {size} {batch} {learning_rate} {beta} {seed} {torch.__version__}"
        self.key = hashlib.sha256(shape.encode() + self.data.numpy().tobytes()).hexdigest()

    def epoch(self) -> None:
        """Train on every image once."""
        torch, total = self.torch, 0.0
        with _one_thread(torch):
            for chosen in torch.randperm(len(self.data), generator=self.generator).split(self.batch):
                self.optimizer.zero_grad()
                wrong, divergence = self.net.terms(self.data[chosen], self.generator)
                (wrong + self.beta * divergence).backward()
                self.optimizer.step()
                total += wrong.item() * len(chosen)
        self.epochs, self.error = self.epochs + 1, total / len(self.data)

    def state(self) -> bytes:
        """Return everything on which the next epoch depends, except the arguments of the constructor."""
        file = io.BytesIO()
        parts = {"net": self.net.state_dict(), "optimizer": self.optimizer.state_dict()}
        progress = {"key": self.key, "epochs": self.epochs, "error": self.error, "chance": self.generator.get_state()}
        self.torch.save(parts | progress, file)
        return file.getvalue()

    def restore(self, state: bytes, most: int) -> bool:
        """Continue from a state; return False if it is of another training, or of more than `most` epochs."""
        try:
            saved = self.torch.load(io.BytesIO(state), weights_only=True)
        except Exception:  # torch raises many kinds of errors for a file that it did not write
            return False
        if not isinstance(saved, dict) or saved.get("key") != self.key or saved["epochs"] > most:
            return False
        self.net.load_state_dict(saved["net"])
        self.optimizer.load_state_dict(saved["optimizer"])
        self.generator.set_state(saved["chance"])
        self.epochs, self.error = saved["epochs"], saved["error"]
        return True

    def encoder(self) -> Encoder:
        """Return the encoder for unscaled images."""
        return _as_arrays(self.net, self.middle, self.spread)


@contextlib.contextmanager
def _one_thread(torch: Any) -> Iterator[None]:
    """Limit torch to one thread: layers this small gain nothing from more, and are slow where a core is busy."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _network(torch: Any, shape: Sequence[int], size: int) -> Any:
    nn, dim = torch.nn, len(shape) - 1
    conv = (nn.Conv2d, nn.Conv3d)[dim - 2]
    channels, sizes = [shape[0], *CHANNELS], [tuple(shape[1:])]
    for _ in CHANNELS:
        sizes.append(tuple(size_after(n) for n in sizes[-1]))
    flat = channels[-1] * int(np.prod(sizes[-1]))

    class Network(nn.Module):  # type: ignore[name-defined]
        def __init__(self) -> None:
            super().__init__()
            pairs = list(itertools.pairwise(channels))
            self.down = nn.ModuleList([conv(a, b, KERNEL, STRIDE, 1) for a, b in pairs])
            self.up = nn.ModuleList([conv(b, a, KERNEL, 1, 1) for a, b in reversed(pairs)])
            self.mean, self.log_variance = nn.Linear(flat, size), nn.Linear(flat, size)
            self.unfold = nn.Linear(size, flat)

        def decode(self, z: Any) -> Any:
            h = self.unfold(z).reshape(len(z), channels[-1], *sizes[-1])
            for k, layer in enumerate(self.up):
                h = layer(nn.functional.interpolate(nn.functional.elu(h), size=sizes[-2 - k]))
            return h

        def terms(self, images: Any, generator: Any) -> tuple[Any, Any]:
            h = images
            for layer in self.down:
                h = nn.functional.elu(layer(h))
            mu, log_var = self.mean(h.flatten(1)), self.log_variance(h.flatten(1))
            z = mu + torch.exp(0.5 * log_var) * torch.randn(mu.shape, generator=generator)
            divergence = -0.5 * (1 + log_var - mu**2 - log_var.exp()).sum(1).mean()
            return ((self.decode(z) - images) ** 2).mean(), divergence

    return Network()


def _as_arrays(net: Any, middle: Array, spread: Array) -> Encoder:
    """Return the encoder of the mean in float64, for unscaled images: its first layer contains the scaling."""
    kernels = [layer.weight.detach().double().numpy() for layer in net.down]
    kernels[0] = kernels[0] / spread.reshape(1, -1, *(1,) * (kernels[0].ndim - 2))
    offsets = [layer.bias.detach().double().numpy() for layer in net.down]
    weights, shift = (a.detach().double().numpy() for a in (net.mean.weight, net.mean.bias))
    return Encoder(tuple(kernels), tuple(offsets), weights, shift, middle.reshape(-1))
