"""Stress and elastic energy of a part of a body, from the law of its material.

The functions that the kernels use for lanes of particles are called here with arrays: of all particles of a part at
some moments.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from cqrun.errors import UsageError
from cqrun.materials.term import energy, energy_vjp, has_energy, has_history, kirchhoff, kirchhoff_vjp
from cqrun.measures.measure import AXES, BoundMeasure
from cqrun.measures.place import OnPart
from cqrun.numerics.tensor import cofactor, det
from cqrun.objectives.design import VOLUME
from cqrun.observers.matter import Material, Matter
from cqrun.observers.rows import single
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin

AT_A_TIME = 65536
"""Number of particles times moments that are processed together."""


@plugin("measure", "stress")
class Stress(OnPart):
    """Cauchy stress [Pa] of the material of a part: the plain mean over its particles, positive in tension.

    It has the elastic and the viscous stress, and not what actuators add. Its components are xx, yy, (zz,) xy(, xz,
    yz), along the axes of the world. It is not known where volumes are averaged (`world.volume`), or where a material
    has a history.
    """

    def bind(self, matter: Matter) -> BoundMeasure:
        return MeanStress(self, matter)


@plugin("measure", "elastic_energy")
class ElasticEnergy(OnPart):
    """Elastic energy of the material of a part: the sum over its particles [J; 2D: J/m].

    It is not known where volumes are averaged (`world.volume`), or where a material has a history.
    """

    def bind(self, matter: Matter) -> BoundMeasure:
        return StoredEnergy(self, matter)


class OfMaterial(BoundMeasure):
    """Base of quantities of a material: one row for each particle of the part.

    Attributes:
        at: positions of the part's particles among the columns of the parameters of the material's terms.
    """

    instant = False

    def __init__(self, spec: OnPart, matter: Matter) -> None:
        self.members = spec.members(matter)
        self.rows = single(self.members, matter.n_particles)
        self.material: Material = matter.materials[spec.body]
        self.at = self.members - self.material.begin
        if matter.averaged:
            raise UsageError(
                f"the {self.meaning} is not known where volumes are averaged: set `world.volume: local`, or measure a "
                "strain"
            )
        kinds = [type(term) for term in self._terms([np.zeros((99, 1)) for _ in self.material.makers])]
        if any(map(has_history, kinds)):
            raise UsageError(f"the {self.meaning} of a material with a history is not known: measure a strain")
        self._require(kinds)

    def _require(self, kinds: list[type]) -> None:
        """Raise UsageError if a term of these classes does not give the quantity."""

    def _terms(self, thetas: list[Array]) -> list[Any]:
        """Return the kernels' views of the material's terms."""
        return [make(theta) for make, theta in zip(self.material.makers, thetas, strict=True)]

    def _pieces(self, track: Track) -> Iterator[tuple[slice, list[Any], list[tuple[Array, ...]], Any, Any]]:
        """Yield some rows of a track at a time: the terms, their parameters, F and C, as tuples of flat arrays."""
        thetas = [theta[:, self.at] for theta in track.terms[self.material.group]]
        terms = self._terms(thetas)
        moments = max(1, AT_A_TIME // len(self.at))
        for begin in range(0, len(track.F), moments):
            rows = slice(begin, begin + moments)
            F, C = _entries(track.F[rows]), _entries(track.C[rows])
            count = len(track.F[rows])
            yield rows, terms, [tuple(np.tile(row, count) for row in theta) for theta in thetas], F, C

    def _terms_bar(self, track: Track, theta_bars: list[Array]) -> list[list[Array]]:
        """Return the cotangent of all parameters from those of the part's (rows, n)."""
        out = [[np.zeros(theta.shape) for theta in group] for group in track.terms]
        for whole, part in zip(out[self.material.group], theta_bars, strict=True):
            whole[:, self.at] = part
        return out


class MeanStress(OfMaterial):
    """sigma = tau / J, averaged over the particles."""

    unit, meaning = "Pa", "Cauchy stress"

    def __init__(self, spec: Stress, matter: Matter) -> None:
        super().__init__(spec, matter)
        i, j = np.triu_indices(matter.dim, 1)
        self.i, self.j = np.concatenate([np.arange(matter.dim), i]), np.concatenate([np.arange(matter.dim), j])
        self.components = tuple(AXES[a] + AXES[b] for a, b in zip(self.i, self.j, strict=True))
        self.entries = self.i * matter.dim + self.j
        self.low, self.high = np.full(len(self.i), -1.0e5), np.full(len(self.i), 1.0e5)

    def values(self, track: Track) -> Array:
        return np.asarray(self.each(track).mean(axis=1))

    def each(self, track: Track) -> Array:
        """Return the stress of every particle of the part (T+1, n, components)."""
        out = np.zeros((len(track.F), len(self.at), len(self.entries)))
        for rows, terms, thetas, F, C in self._pieces(track):
            tau = _sum(kirchhoff(term, theta, F, C, ()) for term, theta in zip(terms, thetas, strict=True))
            for k, entry in enumerate(self.entries):
                out[rows, :, k] = (tau[entry] / det(F)).reshape(-1, len(self.at))
        return out

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        F_bar, C_bar = np.zeros(track.F.shape), np.zeros(track.C.shape)
        theta_bars = [np.zeros((len(theta), len(self.at))) for theta in track.terms[self.material.group]]
        for rows, terms, thetas, F, C in self._pieces(track):
            J = det(F)
            each = np.repeat(bar[rows] / len(self.at), len(self.at), axis=0)
            tau_bar = [0.0 * J for _ in F]
            for k, entry in enumerate(self.entries):
                tau_bar[entry] = each[:, k] / J
            F_piece, C_piece, stress = [0.0 * J for _ in F], [0.0 * J for _ in F], 0.0 * J
            for term, theta, total in zip(terms, thetas, theta_bars, strict=True):
                tau = kirchhoff(term, theta, F, C, ())
                stress = stress + sum(t * b for t, b in zip(tau, tau_bar, strict=True))
                by_theta, by_F, by_C = kirchhoff_vjp(term, theta, F, C, (), tuple(tau_bar))[:3]
                total += _per_particle(by_theta, len(self.at))
                F_piece = [a + b for a, b in zip(F_piece, by_F, strict=True)]
                C_piece = [a + b for a, b in zip(C_piece, by_C, strict=True)]
            through_J = [c * (-stress / J) for c in cofactor(F)]  # sigma = tau / J
            F_bar[rows] = _matrices([a + b for a, b in zip(F_piece, through_J, strict=True)], track.F[rows].shape)
            C_bar[rows] = _matrices(C_piece, track.C[rows].shape)
        return TrackBar(F=F_bar, C=C_bar, terms=self._terms_bar(track, theta_bars))


class StoredEnergy(OfMaterial):
    """Sum of volume at rest times psi."""

    meaning = "elastic energy"

    def __init__(self, spec: ElasticEnergy, matter: Matter) -> None:
        super().__init__(spec, matter)
        self.unit = "J" if matter.dim == 3 else "J/m"
        self.room = matter.room[self.members]

    def _require(self, kinds: list[type]) -> None:
        unknown = [kind.__name__.removesuffix("Kernel") for kind in kinds if not has_energy(kind)]
        if unknown:
            raise UsageError(f"the energy of {unknown[0]} is not known: its file must call `register_energy`")

    def values(self, track: Track) -> Array:
        out, volume = np.zeros((len(track.F), 1)), track.design[VOLUME, self.members] / self.room
        for rows, terms, thetas, F, _ in self._pieces(track):
            psi = sum(energy(term, theta, F) for term, theta in zip(terms, thetas, strict=True))
            out[rows, 0] = np.reshape(psi, (-1, len(self.at))) @ volume
        return out

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        volume = track.design[VOLUME, self.members] / self.room
        F_bar, design_bar = np.zeros(track.F.shape), np.zeros(track.design.shape)
        theta_bars = [np.zeros((len(theta), len(self.at))) for theta in track.terms[self.material.group]]
        for rows, terms, thetas, F, _ in self._pieces(track):
            each = (bar[rows] * volume).ravel()
            total = [0.0 * each for _ in F]
            for term, theta, theta_bar in zip(terms, thetas, theta_bars, strict=True):
                psi = energy(term, theta, F).reshape(-1, len(self.at))
                design_bar[VOLUME, self.members] += bar[rows, 0] @ psi / self.room
                by_theta, by_F = energy_vjp(term, theta, F, each)
                theta_bar += _per_particle(by_theta, len(self.at))
                total = [a + b for a, b in zip(total, by_F, strict=True)]
            F_bar[rows] = _matrices(total, track.F[rows].shape)
        return TrackBar(F=F_bar, design=design_bar, terms=self._terms_bar(track, theta_bars))


def _entries(field: Array) -> tuple[Array, ...]:
    """Return matrices (T, n, D, D) as a tuple of D * D flat arrays (T * n,)."""
    return tuple(np.ascontiguousarray(field.reshape(-1, field.shape[-1] ** 2).T))


def _matrices(entries: list[Array], shape: tuple[int, ...]) -> Array:
    """Return the adjoint of `_entries`: matrices of a shape (T, n, D, D)."""
    return np.stack(entries, axis=-1).reshape(shape)


def _per_particle(rows: Any, n: int) -> Array:
    """Return cotangents of parameters at all moments, summed over the moments (rows, n)."""
    return np.array([np.reshape(row, (-1, n)).sum(axis=0) for row in rows])


def _sum(parts: Iterator[tuple[Array, ...]]) -> list[Array]:
    """Return the sum of tensors."""
    return [sum(entries[1:], entries[0]) for entries in zip(*parts, strict=True)]
