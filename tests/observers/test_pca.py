"""Principal components of a deformation: they are found again, and see shape alone."""

from __future__ import annotations

import numpy as np
import pytest
from made_matter import made_matter

from cqrun.errors import UsageError
from cqrun.observers.observer import Moment
from cqrun.observers.pca import Pca, fit_components, load_components, save_components
from cqrun.state import State


def known_modes(n: int, dim: int, rng: np.random.Generator) -> np.ndarray:
    """Return 2 orthonormal modes (2, n, dim) that leave the centroid alone."""
    raw = rng.normal(size=(2, n, dim))
    raw -= raw.mean(axis=1, keepdims=True)
    return np.linalg.qr(raw.reshape(2, -1).T)[0].T.reshape(2, n, dim)


def bent(matter, rng, frames=40):
    """Return a trajectory of the arm that wanders and bends in two ways, and what it bends by (frames, 2)."""
    x = matter.x[matter.members("arm")]
    amounts = rng.normal(size=(frames, 2)) * [0.3, 0.05]
    amounts[0] = 0.0
    modes = known_modes(len(x), matter.dim, rng)
    drift = rng.normal(size=(frames, 1, matter.dim))
    drift[0] = 0.0
    return x + drift + np.einsum("tk,knd->tnd", amounts, modes), amounts, modes


def seen(bound, x):
    rows = bound.rows @ x
    none = np.zeros((len(rows), 0))
    return bound.observe(Moment(rows, none, none, none, 0.0, 0, {}, np.zeros(0), lambda: State.at_rest(x)))[0]


@pytest.mark.parametrize("dim", [2, 3])
def test_the_ways_a_body_bends_are_found(dim, rng):
    matter = made_matter(dim)
    trajectory, amounts, modes = bent(matter, rng, frames=500)
    found = fit_components(trajectory, 2)
    overlap = np.abs(np.einsum("ind,jnd->ij", found.modes, modes))
    np.testing.assert_allclose(overlap, np.eye(2), atol=0.02)
    variance = (amounts - amounts.mean(axis=0)).var(axis=0)
    np.testing.assert_allclose(found.explained, variance / variance.sum(), rtol=0.02)
    np.testing.assert_allclose(found.modes.mean(axis=1), 0.0, atol=1e-12)


def test_motions_count_from_their_own_rest(rng):
    """A body that is longer in one run than in the other has not deformed."""
    trajectory, _, _ = bent(made_matter(2), rng)
    longer = trajectory.copy()
    longer[..., 0] += 0.5 * trajectory[0, :, 0]
    both = np.concatenate([trajectory, longer])
    one, two = fit_components(trajectory, 2), fit_components(both, 2, [0, len(trajectory)])
    np.testing.assert_allclose(two.modes, one.modes, atol=1e-12)
    np.testing.assert_allclose(two.explained, one.explained, atol=1e-12)
    assert fit_components(both, 3).explained[0] > 0.5, "counted from the first one's, length is the first component"


@pytest.mark.parametrize("dim", [2, 3])
def test_coordinates_give_the_shape_back_wherever_it_is(dim, rng):
    matter = made_matter(dim)
    trajectory, _, _ = bent(matter, rng)
    found = fit_components(trajectory, 2)
    bound = Pca(body="arm", components=2).bind_to(matter, found)
    x = matter.x.copy()
    for frame in (3, 17):
        x[matter.members("arm")] = trajectory[frame]
        z = seen(bound, x)
        shape = trajectory[0] + found.mean + np.einsum("k,knd->nd", z, found.modes)
        np.testing.assert_allclose(shape - shape.mean(axis=0), trajectory[frame] - trajectory[frame].mean(axis=0),
                                   atol=1e-12)  # fmt: skip
        np.testing.assert_allclose(seen(bound, x + 0.3), z, atol=1e-12)
        slack = 1e-12 * bound.high  # one of these frames may be the one that reaches farthest
        assert ((bound.low - slack <= z) & (z <= bound.high + slack)).all()


def test_fewer_components_are_the_first_ones(rng):
    matter = made_matter(2)
    trajectory, _, _ = bent(matter, rng)
    found = fit_components(trajectory, 2)
    both, one = (Pca(body="arm", components=k).bind_to(matter, found) for k in (2, 1))
    np.testing.assert_array_equal(seen(one, matter.x), seen(both, matter.x)[:1])


def test_the_fit_is_the_same_each_time(rng):
    trajectory, _, _ = bent(made_matter(2), rng)
    modes = fit_components(trajectory, 2).modes.reshape(2, -1)
    np.testing.assert_array_equal(fit_components(trajectory, 2).modes.reshape(2, -1), modes)
    assert (modes[np.arange(2), np.abs(modes).argmax(axis=1)] > 0).all()


def test_a_file_gives_the_same_observer(tmp_path, rng):
    matter = made_matter(2)
    trajectory, _, _ = bent(matter, rng)
    save_components(tmp_path / "modes.npz", fit_components(trajectory, 2))
    bound = Pca(body="arm", components=2, file=str(tmp_path / "modes.npz")).bind(matter)
    fitted = Pca(body="arm", components=2).bind_to(matter, fit_components(trajectory, 2))
    x = rng.normal(size=matter.x.shape)
    np.testing.assert_array_equal(seen(bound, x), seen(fitted, x))


def test_what_does_not_fit(tmp_path, rng):
    matter = made_matter(2)
    trajectory, _, _ = bent(matter, rng)
    found = fit_components(trajectory, 2)
    with pytest.raises(UsageError, match="deforms the body in 2 ways; 3 components"):
        fit_components(trajectory, 3)
    with pytest.raises(UsageError, match="deforms the body in 0 ways"):
        fit_components(np.tile(trajectory[:1], (5, 1, 1)), 1)
    with pytest.raises(UsageError, match="of a 2D body of 12 particles; 'ball' has 4 in 2D"):
        Pca(body="ball", components=1).bind_to(matter, found)
    with pytest.raises(UsageError, match="3 components are wanted, 2 were fitted"):
        Pca(body="arm", components=3).bind_to(matter, found)
    np.savez(tmp_path / "other.npz", modes=np.zeros(3))
    with pytest.raises(UsageError, match="must hold the arrays modes, mean, reach, explained"):
        load_components(tmp_path / "other.npz")
    with pytest.raises(UsageError, match="cannot be read as file of principal components"):
        Pca(body="arm", components=1, file=str(tmp_path / "none.npz")).bind(matter)
