"""What averaged volumes change in the stress and the energy of each particle.

Where volumes are averaged (engine/reference/volume.py), the part U(J) of a material's energy acts at the corners of
cells. So the particle p has in place of f(theta_p, J_p) the sum over corners of N_cp f(theta_c, J_c):

    J_c = sum_p N_cp vol0_p J_p / V_c,   theta_c = sum_p N_cp vol0_p theta_p / V_c,   V_c = sum_p N_cp vol0_p.

For the stress f is the pressure U', for the energy per volume f is U. The energies of all particles then sum up to
sum_c V_c U(J_c): each corner's energy is divided among its particles by N_cp vol0_p.

Adjoint, with the cotangent g_p of this sum, r_c = df/dJ_c sum_p N_cp g_p / V_c, and s_c the same by theta:

    J_bar_p = vol0_p sum_c N_cp r_c,   theta_bar_p = vol0_p sum_c N_cp s_c,
    N_bar_cp = g_p f(theta_c, J_c) + vol0_p (r_c (J_p - J_c) + s_c . (theta_p - theta_c)).

The cotangent of vol0_p is the sum over c of N_cp times the last bracket.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from cqrun.materials.term import has_volume, volume_slope, volume_slope_vjp
from cqrun.numerics.tensor import cofactor, det
from cqrun.objectives.design import VOLUME
from cqrun.observers.matter import Corners, Matter
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array

GAUSS = [(0.5 + 0.5 * a, 0.5 * w) for a, w in zip(*np.polynomial.legendre.leggauss(16), strict=True)]
"""Nodes and weights on [0, 1]. They integrate slopes to rounding for volume ratios between 0.4 and 3."""


class Law(NamedTuple):
    """A function f(term, theta, J) of the volume ratio, and its adjoint, which returns (theta_bar, J_bar)."""

    f: Callable[..., Any]
    vjp: Callable[..., Any]


def volume_energy(term: Any, theta: Any, J: Any) -> Any:
    """Return U of a term with U(1) = 0, the integral of its slope."""
    slopes = (w * volume_slope(term, theta, 1.0 + a * (J - 1.0)) for a, w in GAUSS)
    return sum(slopes) * (J - 1.0)


def volume_energy_vjp(term: Any, theta: Any, J: Any, energy_bar: Any) -> Any:
    """Return (theta_bar, J_bar)."""
    theta_bar: Any = 0.0
    for a, w in GAUSS:
        part = volume_slope_vjp(term, theta, 1.0 + a * (J - 1.0), w * (J - 1.0) * energy_bar)[0]
        theta_bar = theta_bar + np.array(part)
    return theta_bar, volume_slope(term, theta, J) * energy_bar


PRESSURE, ENERGY = Law(volume_slope, volume_slope_vjp), Law(volume_energy, volume_energy_vjp)


class Seen(NamedTuple):
    """A body's particles and corners in a record of T+1 moments; parameters are those of the terms with a U."""

    J: Array  # (T+1, n)
    volume: Array  # (n,)
    thetas: list[Array]  # (rows, n)
    full: Array  # (C,) numbers of the corners that have particles
    hats: Any  # (C, n)
    V: Array  # (C,)
    J_c: Array  # (T+1, C)
    thetas_c: list[Array]  # (rows, C)


class Averaging:
    """The difference between sum_c N_cp f(theta_c, J_c) and f(theta_p, J_p), of every particle of a body.

    Args:
        body: its name; the record has one row for each of its particles.
        law: the function f.
        matter: the scene's particles.
        corners: the corners of cells.
    """

    def __init__(self, body: str, law: Law, matter: Matter, corners: Corners) -> None:
        self.members, self.material = matter.members(body), matter.materials[body]
        self.law, self.corners, self.room = law, corners, matter.room[self.members]
        self.at = self.members - self.material.begin
        views = [make(np.zeros((99, 1))) for make in self.material.makers]
        self.terms = {k: view for k, view in enumerate(views) if has_volume(type(view))}

    def values(self, track: Track) -> Array:
        """Return the difference (T+1, n)."""
        seen = self._seen(track)
        return np.asarray(self._sum(seen.thetas_c, seen.J_c) @ seen.hats - self._sum(seen.thetas, seen.J))

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        """Return the cotangents of F, volumes, parameters and rest positions from that of the difference (T+1, n)."""
        seen = self._seen(track)
        terms_bar = [[np.zeros(theta.shape) for theta in group] for group in track.terms]
        r, S, J_bar = np.zeros(seen.J_c.shape), list[Array](), np.zeros(seen.J.shape)
        for (k, term), theta, theta_c in zip(self.terms.items(), seen.thetas, seen.thetas_c, strict=True):
            by_theta, by_J = self.law.vjp(term, tuple(theta_c), seen.J_c, bar @ seen.hats.T)
            r += by_J / seen.V
            S.append(_sums(by_theta, seen.J_c) / seen.V)
            by_theta, by_J = self.law.vjp(term, tuple(theta), seen.J, -bar)
            J_bar += by_J
            back = seen.volume * (S[-1] @ seen.hats)
            terms_bar[self.material.group][k][:, self.at] = _sums(by_theta, seen.J) + back
        J_bar += seen.volume * (r @ seen.hats)

        def shares(weights: Any) -> Array:
            """Return the sum over corners of weights times r_c (J_p - J_c) + s_c . (theta_p - theta_c) (n,)."""
            total = ((seen.J - 1.0) * (r @ weights)).sum(axis=0) - (r * (seen.J_c - 1.0)).sum(axis=0) @ weights
            for s, theta, theta_c in zip(S, seen.thetas, seen.thetas_c, strict=True):
                total += (theta * (s @ weights)).sum(axis=0) - (s * theta_c).sum(axis=0) @ weights
            return np.asarray(total)

        design_bar, rest_bar = np.zeros(track.design.shape), np.zeros(track.rest.shape)
        design_bar[VOLUME, self.members] = shares(seen.hats) / self.room
        f_c = self._sum(seen.thetas_c, seen.J_c)
        for axis, slopes in enumerate(self.corners.slopes(track.rest)):
            own_slopes = slopes[:, self._columns()][seen.full]
            rest_bar[self.members, axis] = (bar * (f_c @ own_slopes)).sum(axis=0) + seen.volume * shares(own_slopes)
        F_bar = np.stack([J_bar * entry for entry in cofactor(_entries(track.F))], axis=-1).reshape(track.F.shape)
        return TrackBar(F=F_bar, design=design_bar, terms=terms_bar, rest=rest_bar)

    def _seen(self, track: Track) -> Seen:
        """Return what a record shows of the particles and corners."""
        J, volume = det(_entries(track.F)), track.design[VOLUME, self.members] / self.room
        thetas = [track.terms[self.material.group][k][:, self.at] for k in self.terms]
        hats = self.corners.hats(track.rest)[:, self._columns()]
        full = np.flatnonzero(hats @ volume > 0.0)
        hats = hats[full]
        V = hats @ volume
        J_c = 1.0 + ((J - 1.0) * volume) @ hats.T / V
        return Seen(J, volume, thetas, full, hats, V, J_c, [(theta * volume) @ hats.T / V for theta in thetas])

    def _columns(self) -> slice:
        return slice(int(self.members[0]), int(self.members[-1]) + 1)

    def _sum(self, thetas: list[Array], J: Array) -> Array:
        """Return the sum of f over the terms."""
        return np.asarray(sum(self.law.f(t, tuple(p), J) for t, p in zip(self.terms.values(), thetas, strict=True)))


def _sums(rows: Any, like: Array) -> Array:
    """Return cotangents of parameters at all moments, summed over the moments (rows, n)."""
    return np.array([np.broadcast_to(row, like.shape).sum(axis=0) for row in rows])


def _entries(F: Array) -> tuple[Array, ...]:
    """Return matrices (T+1, n, D, D) as a tuple of their entries (T+1, n)."""
    return tuple(np.moveaxis(F.reshape(*F.shape[:2], -1), -1, 0))
