"""Stress and elastic energy where volumes are averaged over the corners of cells, in cases with known answers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from made_matter import averaged_matter, box_around_left
from made_tracks import a_track
from scipy.integrate import quad

from cqrun.materials.term import energy, has_volume, volume_slope, volume_slope_vjp
from cqrun.measures.averaged import volume_energy, volume_energy_vjp
from cqrun.measures.measure import BoundMeasure
from cqrun.objectives.design import VOLUME
from cqrun.observers.matter import Matter
from cqrun.observers.track import Track
from cqrun.plugin.registry import plugins

DIM = pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])
BODY = pytest.mark.parametrize("body", ["arm", "ball"])
LAWS = [("neo_hookean", "elastic"), ("fixed_corotated", "elastic"), ("incompressibility", "material_term")]


def bound(name: str, matter: Matter, **fields: Any) -> BoundMeasure:
    return plugins("measure")[name].model_validate(fields).bind(matter)


def local(matter: Matter) -> Matter:
    return replace(matter, corners=None)


def random_track(matter: Matter, rows: int) -> Track:
    """Return a track of a stretched and turned body that is still deformed at random."""
    dim, rng = matter.dim, np.random.default_rng(3)
    track = a_track(rows, dim, rng)
    same = np.diag([1.2, 0.9, 1.05][:dim]) @ np.linalg.qr(rng.normal(size=(dim, dim)))[0]
    if np.linalg.det(same) < 0.0:
        same[:, 0] *= -1.0
    return replace(track, F=same + 0.1 * track.F, rest=matter.x)


def uniform(track: Track) -> Track:
    """Return the track with the deformation and the parameters of its first particle everywhere."""
    terms = [[np.repeat(theta[:, :1], theta.shape[1], axis=1) for theta in group] for group in track.terms]
    return replace(track, F=np.repeat(track.F[:, :1], track.F.shape[1], axis=1), terms=terms)


@DIM
@BODY
@pytest.mark.parametrize("name", ["stress", "elastic_energy"])
def test_a_uniform_stretch_gives_what_local_volumes_give(name, body, dim):
    matter, place = averaged_matter(dim), {"group": "tip"} if dim == 2 else {"region": box_around_left(dim)}
    place = place if body == "arm" else {}
    averaged, own = bound(name, matter, body=body, **place), bound(name, local(matter), body=body, **place)
    track = uniform(random_track(matter, averaged.rows.shape[0]))
    at = own.members - matter.members(body)[0]
    fewer = replace(track, F=track.F[:, at], C=track.C[:, at])
    assert averaged.values(track) == pytest.approx(own.values(fewer), rel=1e-12, abs=1e-12)


@DIM
@BODY
def test_the_stress_of_all_particles_is_the_derivative_of_the_energy(body, dim):
    """The sum of vol0 J sigma F^-T : dF is what the energy of the body grows by, although U acts at the corners."""
    matter = averaged_matter(dim)
    stored, stress = bound("elastic_energy", matter, body=body), bound("stress", matter, body=body)
    track = random_track(matter, stored.rows.shape[0])
    track.C[:] = 0.0
    F_bar, sigma = stored.values_vjp(track, np.ones((len(track.F), 1))).F, np.zeros(track.F.shape)
    for k, (i, j) in enumerate(zip(stress.i, stress.j, strict=True)):
        sigma[..., i, j] = sigma[..., j, i] = stress.each(track)[..., k]
    members = matter.members(body)
    volume = track.design[VOLUME, members] / matter.room[members] * np.linalg.det(track.F)
    expected = volume[..., None, None] * sigma @ np.swapaxes(np.linalg.inv(track.F), 2, 3)
    assert F_bar == pytest.approx(expected, rel=1e-9, abs=1e-9)


@DIM
def test_the_energies_of_two_halves_are_that_of_the_whole_and_differ_from_those_of_local_volumes(dim):
    matter = averaged_matter(dim)
    halves = {"arm": {"a": np.arange(0, 5), "b": np.arange(5, len(matter.members("arm")))}, "ball": {}}
    matter = replace(matter, groups=halves)
    whole, a, b = (bound("elastic_energy", matter, body="arm", group=group) for group in (None, "a", "b"))
    track = random_track(matter, whole.rows.shape[0])
    assert a.values(track) + b.values(track) == pytest.approx(whole.values(track), rel=1e-12)
    own = bound("elastic_energy", local(matter), body="arm").values(track)
    assert np.all(whole.values(track) < own - 1e-3)  # a mean of volumes costs less than their changes


@pytest.mark.parametrize(("name", "kind"), LAWS)
def test_the_energy_of_volume_is_the_integral_of_its_slope(name, kind):
    fields = {} if name == "incompressibility" else {"youngs_modulus": 2.0, "poissons_ratio": 0.3}
    term = plugins(kind)[name](**fields).kernel_term(np.zeros((2, 1)))
    assert has_volume(type(term))
    for ratio in (0.4, 0.9, 1.0, 3.0):
        J, theta = np.array([ratio]), (np.array([2.0]), np.array([0.3]))
        expected = quad(lambda s: volume_slope(term, theta, np.array([s]))[0], 1.0, ratio, epsabs=0.0, epsrel=1e-13)[0]  # noqa: B023
        assert volume_energy(term, theta, J) == pytest.approx(expected, rel=1e-12, abs=1e-15)
        theta_bar, J_bar = volume_energy_vjp(term, theta, J, np.array([2.0]))
        assert J_bar == pytest.approx(2.0 * volume_slope(term, theta, J), rel=1e-14)
        assert theta_bar[0] == pytest.approx(2.0 * expected / 2.0, rel=1e-12, abs=1e-15)  # linear in E


def test_the_energy_of_volume_is_that_of_laws_that_have_nothing_else():
    term = plugins("material_term")["incompressibility"](power=4).kernel_term(np.zeros((2, 1)))
    theta, F = (np.array([2.0]), np.array([0.3])), tuple(np.diag([1.3, 0.9]).reshape(4, 1))
    assert volume_energy(term, theta, np.array([1.17])) == pytest.approx(energy(term, theta, F), rel=1e-13)
    assert volume_slope_vjp(term, theta, np.array([1.17]), np.ones(1))[1] > 0.0
