"""Training the autoencoder of the observer `vae` (needs torch; `make test-rl`)."""

from __future__ import annotations

import numpy as np
import pytest

from cqrun.observers import vae_training
from cqrun.observers.vae_training import Training

pytestmark = pytest.mark.rl


def train(images, size, epochs):
    training = Training(images, size)
    errors = []
    while training.epochs < epochs:
        training.epoch()
        errors.append(training.error)
    return training.encoder(), errors


@pytest.fixture
def images():
    """Return images (80, 3, 12, 12) of one phase: what a code of few numbers can tell."""
    phase = np.linspace(0.0, 2.0 * np.pi, 80, endpoint=False)[:, None, None, None]
    channel, i, j = np.ogrid[1:4, 0:12, 0:12]
    return channel * np.sin(phase + i / 3) * np.cos(2 * phase + j / 4) + 0.5 * channel


def test_a_code_learns_what_varies(images):
    encoder, errors = train(images, 4, epochs=60)
    assert errors[-1] < 0.1 * errors[0]
    codes = np.array([encoder.encode(image) for image in images])
    assert codes.shape == (80, 4)
    nearest = np.argsort(((codes[:, None] - codes) ** 2).sum(axis=2), axis=1)[:, 1]
    steps = np.abs(nearest - np.arange(80))
    assert np.mean(np.minimum(steps, 80 - steps) <= 2) > 0.9, "neighbours in time are neighbours in the code"


def test_the_same_seed_gives_the_same_code(images):
    one, two = (train(images, 2, epochs=3)[0].encode(images[5]) for _ in range(2))
    np.testing.assert_array_equal(one, two)


def test_a_training_goes_on_from_its_state_to_the_same_bits(images):
    whole, half = Training(images, 2), Training(images, 2)
    for _ in range(4):
        whole.epoch()
    half.epoch()
    half.epoch()
    rest = Training(images, 2)
    assert rest.restore(half.state(), 4)
    assert rest.epochs == 2
    rest.epoch()
    rest.epoch()
    assert rest.error == whole.error
    np.testing.assert_array_equal(rest.encoder().encode(images[5]), whole.encoder().encode(images[5]))


def test_the_state_of_another_training_is_not_taken(images):
    state = Training(images, 2).state()
    assert not Training(images, 2, seed=1).restore(state, 4)
    assert not Training(images + 1.0, 2).restore(state, 4)
    assert not Training(images, 2).restore(b"no state", 4)
    assert not Training(images, 2).restore(state, -1), "it has had more epochs than are asked for"


def test_a_channel_that_never_varies_does_not_drown_the_others(images):
    images[:, 2] = 0.25
    encoder, errors = train(images, 2, epochs=5)
    assert errors[-1] < errors[0]
    assert np.abs(encoder.encode(images[3] + 1e-3)).max() < 100.0


def test_the_arrays_compute_what_the_network_does(images, monkeypatch):
    import torch

    kept = {}
    as_arrays = vae_training._as_arrays
    monkeypatch.setattr(vae_training, "_as_arrays", lambda net, *units: kept.update(net=net) or as_arrays(net, *units))
    encoder, _ = train(images, 3, epochs=2)
    net, axes = kept["net"].double(), (0, 2, 3)
    scaled = (images - images.mean(axis=axes, keepdims=True)) / images.std(axis=axes, keepdims=True)
    h = torch.tensor(scaled[7:8])
    for layer in net.down:
        h = torch.nn.functional.elu(layer(h))
    np.testing.assert_allclose(encoder.encode(images[7]), net.mean(h.flatten(1)).detach().numpy()[0], atol=1e-10)


def test_threads_are_given_back(images):
    import torch

    before = torch.get_num_threads()
    train(images[:8], 2, epochs=1)
    assert torch.get_num_threads() == before
