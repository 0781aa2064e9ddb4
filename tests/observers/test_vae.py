"""The autoencoder's observer: image, encoder and their adjoints, and its file."""

from __future__ import annotations

import numpy as np
import pytest
from made_encoders import made_encoder

from cqrun.errors import UsageError
from cqrun.observers.encoder import convolved
from cqrun.observers.raster import Raster
from cqrun.observers.vae import load_encoder, save_encoder

DIM = pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])
TINY = 1e-30


def particles(dim: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return positions, some beyond the grid's edge, and velocities."""
    return 0.5 + 0.3 * rng.normal(size=(40, dim)), rng.normal(size=(40, dim))


@DIM
def test_image_contains_every_particle_and_the_whole_momentum(dim, rng):
    x, v = particles(dim, rng)
    image = Raster(6, 0.2, 2.0, dim).image(x, v)
    assert image[0].mean() == pytest.approx(1.0)
    np.testing.assert_allclose(image[1:].reshape(dim, -1).mean(axis=1), v.mean(axis=0) / 2.0)


@DIM
def test_image_moves_with_the_body(dim, rng):
    x, v = particles(dim, rng)
    raster = Raster(6, 0.2, 2.0, dim)
    np.testing.assert_allclose(raster.image(x + 0.37, v), raster.image(x, v), atol=1e-12)


@DIM
def test_dot_product_of_image_and_encoder(dim, rng):
    trained = made_encoder(dim, rng)
    (x, v), (dx, dv) = particles(dim, rng), rng.normal(size=(2, 40, dim))
    z_bar = rng.normal(size=2)
    moved = trained.encoder.encode(trained.raster.image(x + 1j * TINY * dx, v + 1j * TINY * dv))
    forward = (moved.imag / TINY) @ z_bar
    image = trained.raster.image(x, v)
    x_bar, v_bar = trained.raster.image_vjp(x, v, trained.encoder.encode_vjp(image, z_bar))
    assert (x_bar * dx).sum() + (v_bar * dv).sum() == pytest.approx(forward, rel=1e-9)


def test_layer_is_a_cross_correlation_at_stride_two(rng):
    kernel, image = rng.normal(size=(2, 3, 3, 3)), rng.normal(size=(3, 5, 7))
    out = convolved(kernel, image)
    assert out.shape == (2, 3, 4)
    padded = np.pad(image, [(0, 0), (1, 1), (1, 1)])
    for i, j in ((0, 0), (1, 2), (2, 3)):
        patch = padded[:, 2 * i : 2 * i + 3, 2 * j : 2 * j + 3]
        np.testing.assert_allclose(out[:, i, j], (kernel * patch).sum(axis=(1, 2, 3)))


@DIM
def test_saved_encoder_is_loaded_unchanged(dim, rng, tmp_path):
    trained = made_encoder(dim, rng)
    save_encoder(tmp_path / "encoder.npz", trained)
    again = load_encoder(tmp_path / "encoder.npz")
    assert again.raster == trained.raster
    image = again.raster.image(*particles(dim, rng))
    np.testing.assert_array_equal(again.encoder.encode(image), trained.encoder.encode(image))


def test_file_of_another_kind_is_an_error(tmp_path):
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(UsageError, match=r"other.npz: is not an encoder file: it must contain the arrays grid"):
        load_encoder(tmp_path / "other.npz")


def test_file_whose_arrays_do_not_fit_each_other_is_an_error(tmp_path, rng):
    trained = made_encoder(2, rng)
    path = tmp_path / "encoder.npz"
    save_encoder(path, trained)
    arrays = dict(np.load(path))
    cells, cell, speed, dim = arrays["grid"]
    for changed, words in [
        ({"grid": np.array([1e6, cell, speed, dim])}, "its grid .* cannot be one; train it again"),
        ({"grid": np.array([cells, cell, 0.0, dim])}, "its grid .* cannot be one; train it again"),
        ({"grid": np.array([cells, cell, speed, 4.0])}, "its grid .* cannot be one; train it again"),
        ({"grid": np.array([2 * cells, cell, speed, dim])}, "the shapes of its arrays do not fit each other"),
        ({"weights": arrays["weights"][:, 1:]}, "the shapes of its arrays do not fit each other"),
        ({"shift": arrays["shift"][1:]}, "the shapes of its arrays do not fit each other"),
        ({"kernel0": arrays["kernel0"][:, :, 1:]}, "the shapes of its arrays do not fit each other"),
        ({"offset0": arrays["offset0"][1:]}, "the shapes of its arrays do not fit each other"),
        ({"middle": arrays["middle"][1:]}, "the shapes of its arrays do not fit each other"),
        ({"shift": np.full_like(arrays["shift"], np.inf)}, "shift of the encoder are not finite numbers"),
    ]:
        np.savez(path, **{**arrays, **changed})
        with pytest.raises(UsageError, match=words):
            load_encoder(path)
