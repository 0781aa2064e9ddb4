"""Training the autoencoder whose code the observer `vae` gives (extra `torch`; the CPU is enough).

    z = mu + sigma noise,   loss = mean |decode(z) - image|^2 + beta KL(N(mu, sigma) | N(0, 1)),

images in units of each channel's spread (D. P. Kingma, M. Welling: Auto-encoding variational Bayes, ICLR 2014). Only
the mean's encoder is kept, as arrays: `encoder.py` runs it without torch.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from cqrun.contract import Array
from cqrun.errors import MissingExtra
from cqrun.observers.encoder import KERNEL, STRIDE, Encoder, size_after

CHANNELS = (16, 32)
"""Channels of the layers."""


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


def train(
    images: Array,
    size: int,
    *,
    epochs: int = 200,
    batch: int = 64,
    learning_rate: float = 1e-3,
    beta: float = 1e-3,
    seed: int = 0,
    progress: Callable[[int, float], None] = lambda epoch, error: None,
) -> tuple[Encoder, float]:
    """Train on images (T, C, G, ...) for codes of `size` numbers; the same seed gives the same on one machine.

    Args:
        epochs, batch, learning_rate: of Adam.
        beta: weight of the divergence.
        progress: called with each epoch and its error.

    Returns:
        The encoder of images as they are, and the share of the images' variance that the code does not explain.

    Raises:
        MissingExtra: torch is not installed.
    """
    torch = library()
    torch.manual_seed(seed)
    axes = (0, *range(2, images.ndim))
    middle = images.mean(axis=axes, keepdims=True)
    spread = images.std(axis=axes, keepdims=True) + 1e-12
    data = torch.tensor((images - middle) / spread, dtype=torch.float32)
    net = _network(torch, data.shape[1:], size)
    optimizer = torch.optim.Adam(net.parameters(), lr=learning_rate)
    order = torch.Generator().manual_seed(seed)
    error = np.inf
    with _one_thread(torch):
        for epoch in range(1, epochs + 1):
            total = 0.0
            for chosen in torch.randperm(len(data), generator=order).split(batch):
                optimizer.zero_grad()
                wrong, divergence = net.terms(data[chosen])
                (wrong + beta * divergence).backward()
                optimizer.step()
                total += wrong.item() * len(chosen)
            error = total / len(data)
            progress(epoch, error)
    return _as_arrays(net, middle, spread), error


@contextlib.contextmanager
def _one_thread(torch: Any) -> Iterator[None]:
    """Have torch use one thread: layers this small gain nothing from more, and lose much where a core is busy."""
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

        def terms(self, images: Any) -> tuple[Any, Any]:
            h = images
            for layer in self.down:
                h = nn.functional.elu(layer(h))
            mu, log_var = self.mean(h.flatten(1)), self.log_variance(h.flatten(1))
            z = mu + torch.exp(0.5 * log_var) * torch.randn_like(mu)
            divergence = -0.5 * (1 + log_var - mu**2 - log_var.exp()).sum(1).mean()
            return ((self.decode(z) - images) ** 2).mean(), divergence

    return Network()


def _as_arrays(net: Any, middle: Array, spread: Array) -> Encoder:
    """Return the mean's encoder in float64, for images as they are: the first layer brings them to one size."""
    kernels = [layer.weight.detach().double().numpy() for layer in net.down]
    kernels[0] = kernels[0] / spread.reshape(1, -1, *(1,) * (kernels[0].ndim - 2))
    offsets = [layer.bias.detach().double().numpy() for layer in net.down]
    weights, shift = (a.detach().double().numpy() for a in (net.mean.weight, net.mean.bias))
    return Encoder(tuple(kernels), tuple(offsets), weights, shift, middle.reshape(-1))
