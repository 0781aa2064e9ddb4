"""Principal components of a deformation: the fit recovers known ones, and they depend on the shape alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_matter import made_matter

from cqrun.errors import UsageError
from cqrun.observers.observer import Moment
from cqrun.observers.pca import Pca, fit_components, load_components, save_components
from cqrun.state import State


def known_modes(n: int, dim: int, rng: np.random.Generator) -> np.ndarray:
    """Return 2 orthonormal modes (2, n, dim) that do not move the centroid."""
    raw = rng.normal(size=(2, n, dim))
    raw -= raw.mean(axis=1, keepdims=True)
    return np.linalg.qr(raw.reshape(2, -1).T)[0].T.reshape(2, n, dim)


def bent(matter, rng, frames=40):
    """Return a trajectory of the arm that drifts and bends in two modes, their amounts (frames, 2), and the modes."""
    x = matter.x[matter.members("arm")]
    amounts = rng.normal(size=(frames, 2)) * [0.3, 0.05]
    amounts[0] = 0.0
    modes = known_modes(len(x), matter.dim, rng)
    drift = rng.normal(size=(frames, 1, matter.dim))
    drift[0] = 0.0
    return x + drift + np.einsum("tk,knd->tnd", amounts, modes), amounts, modes


def coordinates(bound, x):
    rows = bound.rows @ x
    none = np.zeros((len(rows), 0))
    return bound.observe(Moment(rows, none, none, none, 0.0, 0, {}, np.zeros(0), lambda: State.at_rest(x)))[0]


@pytest.mark.parametrize("dim", [2, 3])
def test_fit_recovers_the_modes_of_a_deformation(dim, rng):
    matter = made_matter(dim)
    trajectory, amounts, modes = bent(matter, rng, frames=500)
    fitted = fit_components(trajectory, 2)
    overlap = np.abs(np.einsum("ind,jnd->ij", fitted.modes, modes))
    np.testing.assert_allclose(overlap, np.eye(2), atol=0.02)
    variance = (amounts - amounts.mean(axis=0)).var(axis=0)
    np.testing.assert_allclose(fitted.explained, variance / variance.sum(), rtol=0.02)
    np.testing.assert_allclose(fitted.modes.mean(axis=1), 0.0, atol=1e-12)


def test_each_motion_is_measured_from_its_first_frame(rng):
    """A body that is longer in one run than in the other has not deformed."""
    trajectory, _, _ = bent(made_matter(2), rng)
    longer = trajectory.copy()
    longer[..., 0] += 0.5 * trajectory[0, :, 0]
    both = np.concatenate([trajectory, longer])
    single, double = fit_components(trajectory, 2), fit_components(both, 2, [0, len(trajectory)])
    np.testing.assert_allclose(double.modes, single.modes, atol=1e-12)
    np.testing.assert_allclose(double.explained, single.explained, atol=1e-12)
    assert fit_components(both, 3).explained[0] > 0.5, "length is the first component otherwise"


@pytest.mark.parametrize("dim", [2, 3])
def test_shape_follows_from_coordinates_wherever_the_body_is(dim, rng):
    matter = made_matter(dim)
    trajectory, _, _ = bent(matter, rng)
    fitted = fit_components(trajectory, 2)
    bound = Pca(body="arm", components=2).bind_to(matter, fitted)
    x = matter.x.copy()
    for frame in (3, 17):
        x[matter.members("arm")] = trajectory[frame]
        z = coordinates(bound, x)
        shape = trajectory[0] + fitted.mean + np.einsum("k,knd->nd", z, fitted.modes)
        np.testing.assert_allclose(shape - shape.mean(axis=0), trajectory[frame] - trajectory[frame].mean(axis=0),
                                   atol=1e-12)  # fmt: skip
        np.testing.assert_allclose(coordinates(bound, x + 0.3), z, atol=1e-12)
        slack = 1e-12 * bound.high  # one of these frames may be the one that reaches farthest
        assert ((bound.low - slack <= z) & (z <= bound.high + slack)).all()


def test_fewer_components_are_the_first_of_more(rng):
    matter = made_matter(2)
    trajectory, _, _ = bent(matter, rng)
    fitted = fit_components(trajectory, 2)
    both, first = (Pca(body="arm", components=k).bind_to(matter, fitted) for k in (2, 1))
    np.testing.assert_array_equal(coordinates(first, matter.x), coordinates(both, matter.x)[:1])


def test_fit_is_deterministic(rng):
    trajectory, _, _ = bent(made_matter(2), rng)
    modes = fit_components(trajectory, 2).modes.reshape(2, -1)
    np.testing.assert_array_equal(fit_components(trajectory, 2).modes.reshape(2, -1), modes)
    assert (modes[np.arange(2), np.abs(modes).argmax(axis=1)] > 0).all()


def test_observer_from_a_file_is_the_same(tmp_path, rng):
    matter = made_matter(2)
    trajectory, _, _ = bent(matter, rng)
    save_components(tmp_path / "modes.npz", fit_components(trajectory, 2))
    bound = Pca(body="arm", components=2, file=str(tmp_path / "modes.npz")).bind(matter)
    fitted = Pca(body="arm", components=2).bind_to(matter, fit_components(trajectory, 2))
    x = rng.normal(size=matter.x.shape)
    np.testing.assert_array_equal(coordinates(bound, x), coordinates(fitted, x))


def test_components_that_do_not_fit_are_an_error(tmp_path, rng):
    matter = made_matter(2)
    trajectory, _, _ = bent(matter, rng)
    fitted = fit_components(trajectory, 2)
    with pytest.raises(UsageError, match="deforms the body in 2 ways; 3 components"):
        fit_components(trajectory, 3)
    with pytest.raises(UsageError, match="deforms the body in 0 ways"):
        fit_components(np.tile(trajectory[:1], (5, 1, 1)), 1)
    with pytest.raises(UsageError, match="of a 2D body of 12 particles; 'ball' has 4 in 2D"):
        Pca(body="ball", components=1).bind_to(matter, fitted)
    with pytest.raises(UsageError, match="`components` is 3, but only 2 were fitted: give at most 2"):
        Pca(body="arm", components=3).bind_to(matter, fitted)
    np.savez(tmp_path / "other.npz", modes=np.zeros(3))
    with pytest.raises(UsageError, match="must contain the arrays modes, mean, reach, explained"):
        load_components(tmp_path / "other.npz")
    with pytest.raises(UsageError, match="cannot be read as a file of principal components"):
        Pca(body="arm", components=1, file=str(tmp_path / "none.npz")).bind(matter)


def test_file_whose_arrays_do_not_fit_each_other_is_an_error(tmp_path, rng):
    fitted = fit_components(bent(made_matter(2), rng)[0], 2)
    path = tmp_path / "modes.npz"
    for changed, words in [
        ({"mean": fitted.mean[1:]}, r"its mean is \d+ x 2, but \d+ x 2 fits its modes"),
        ({"reach": fitted.reach[:1]}, "its reach is 1, but 2 fits its modes"),
        ({"reach": np.array(["a", "b"])}, "reach of the components are not finite numbers"),
        ({"modes": np.full_like(fitted.modes, np.nan)}, "modes of the components are not finite numbers"),
    ]:
        save_components(path, replace(fitted, **changed))
        with pytest.raises(UsageError, match=words):
            load_components(path)
