"""Stress, elastic energy and dissipated energy of a part of a body, from the law of its material.

The functions that the kernels use for lanes of particles are called here with arrays: of all particles of a part at
some moments.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, ClassVar

import numpy as np

from cqrun.errors import UsageError
from cqrun.materials.term import energy, energy_vjp, has_energy, has_history, kirchhoff, kirchhoff_vjp, needs_rate
from cqrun.measures.averaged import ENERGY, PRESSURE, Averaging, Law
from cqrun.measures.measure import AXES, BoundMeasure
from cqrun.measures.place import OnPart
from cqrun.measures.work import accumulated, accumulated_vjp
from cqrun.numerics.tensor import add, cofactor, det, inner, scale, sub
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
    yz), along the axes of the world. Where volumes are averaged (`world.volume`), it has the mean pressure. It is not
    known where a material has a history.
    """

    def bind(self, matter: Matter) -> BoundMeasure:
        return MeanStress(self, matter)


@plugin("measure", "elastic_energy")
class ElasticEnergy(OnPart):
    """Elastic energy of the material of a part: the sum over its particles [J; 2D: J/m].

    Where volumes are averaged (`world.volume`), the energy of each mean belongs to its particles by their shares of
    it. It is not known where a material has a history.
    """

    def bind(self, matter: Matter) -> BoundMeasure:
        return StoredEnergy(self, matter)


@plugin("measure", "dissipated_energy")
class DissipatedEnergy(OnPart):
    """Energy that the viscosity of a part's material has turned into heat since the start [J; 2D: J/m].

    The power, the sum over particles of the volume at rest times tau_v : d, is integrated by the trapezoidal rule over
    the control steps: the error falls with the square of the control step, so choose one that shows the motion.
    Damping of the motion (`damping`) and friction are not in it, nor is what the grid of the updated frame takes. It
    is zero without viscosity, and not known where a material has a history.
    """

    needs_time: ClassVar[bool] = True

    def bind(self, matter: Matter) -> BoundMeasure:
        return LostEnergy(self, matter)


class OfMaterial(BoundMeasure):
    """Base of quantities of a material: one row for each particle, of the part or, with averaged volumes, of the body.

    Attributes:
        members: the particles of the rows.
        at: their positions among the columns of the parameters of the material's terms.
        inside: (n,) 1 for those of the part.
        law: what averaged volumes average of the energy U(J), if the quantity depends on it.
        averaging: what averaged volumes change, or None.
    """

    instant = False
    law: ClassVar[Law | None] = None

    def __init__(self, spec: OnPart, matter: Matter) -> None:
        self.members = part = spec.members(matter)
        self.averaging: Averaging | None = None
        if matter.corners is not None and self.law is not None:
            self.members = matter.members(spec.body)
            self.averaging = Averaging(spec.body, self.law, matter, matter.corners)
        self.inside = np.isin(self.members, part).astype(float)
        self.rows = single(self.members, matter.n_particles)
        self.material: Material = matter.materials[spec.body]
        self.at = self.members - self.material.begin
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

    def _with_averages(self, out: TrackBar, track: Track, each: Array) -> TrackBar:
        """Return a cotangent with that through what averaged volumes change at each particle, `each` (T+1, n)."""
        if self.averaging is not None:
            more = self.averaging.values_vjp(track, each)
            out.F = np.asarray(out.F) + np.asarray(more.F)
            out.add_inputs_of(more)
        return out


class MeanStress(OfMaterial):
    """sigma = tau / J, averaged over the particles."""

    unit, meaning, law = "Pa", "Cauchy stress", PRESSURE

    def __init__(self, spec: Stress, matter: Matter) -> None:
        super().__init__(spec, matter)
        self.share = self.inside / self.inside.sum()
        self.normal = slice(0, matter.dim)  # the components xx, yy, zz
        i, j = np.triu_indices(matter.dim, 1)
        self.i, self.j = np.concatenate([np.arange(matter.dim), i]), np.concatenate([np.arange(matter.dim), j])
        self.components = tuple(AXES[a] + AXES[b] for a, b in zip(self.i, self.j, strict=True))
        self.entries = self.i * matter.dim + self.j
        self.low, self.high = np.full(len(self.i), -1.0e5), np.full(len(self.i), 1.0e5)

    def values(self, track: Track) -> Array:
        return np.einsum("tnk,n->tk", self.each(track), self.share)

    def each(self, track: Track) -> Array:
        """Return the stress of every particle of `members` (T+1, n, components)."""
        out = np.zeros((len(track.F), len(self.at), len(self.entries)))
        for rows, terms, thetas, F, C in self._pieces(track):
            tau = _sum(kirchhoff(term, theta, F, C) for term, theta in zip(terms, thetas, strict=True))
            for k, entry in enumerate(self.entries):
                out[rows, :, k] = (tau[entry] / det(F)).reshape(-1, len(self.at))
        if self.averaging is not None:
            out[:, :, self.normal] += self.averaging.values(track)[:, :, None]
        return out

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        F_bar, C_bar = np.zeros(track.F.shape), np.zeros(track.C.shape)
        theta_bars = [np.zeros((len(theta), len(self.at))) for theta in track.terms[self.material.group]]
        for rows, terms, thetas, F, C in self._pieces(track):
            J = det(F)
            each = (bar[rows, None] * self.share[:, None]).reshape(-1, bar.shape[1])
            tau_bar = [0.0 * J for _ in F]
            for k, entry in enumerate(self.entries):
                tau_bar[entry] = each[:, k] / J
            F_piece, C_piece, stress = [0.0 * J for _ in F], [0.0 * J for _ in F], 0.0 * J
            for term, theta, total in zip(terms, thetas, theta_bars, strict=True):
                tau = kirchhoff(term, theta, F, C)
                stress = stress + sum(t * b for t, b in zip(tau, tau_bar, strict=True))
                by_theta, by_F, by_C = kirchhoff_vjp(term, theta, F, C, tuple(tau_bar))[:3]
                total += _per_particle(by_theta, len(self.at))
                F_piece = [a + b for a, b in zip(F_piece, by_F, strict=True)]
                C_piece = [a + b for a, b in zip(C_piece, by_C, strict=True)]
            through_J = [c * (-stress / J) for c in cofactor(F)]  # sigma = tau / J
            F_bar[rows] = _matrices([a + b for a, b in zip(F_piece, through_J, strict=True)], track.F[rows].shape)
            C_bar[rows] = _matrices(C_piece, track.C[rows].shape)
        out = TrackBar(F=F_bar, C=C_bar, terms=self._terms_bar(track, theta_bars))
        return self._with_averages(out, track, bar[:, self.normal].sum(axis=1, keepdims=True) * self.share)


class EnergyOfMaterial(OfMaterial):
    """Base of energies: sums over the particles of the part of the volume at rest times an energy density."""

    def __init__(self, spec: OnPart, matter: Matter) -> None:
        super().__init__(spec, matter)
        self.unit = "J" if matter.dim == 3 else "J/m"
        self.room = matter.room[self.members]

    def _volume(self, track: Track) -> Array:
        """Return the volumes at rest of the particles (n,); 0 outside the part."""
        return np.asarray(track.design[VOLUME, self.members] * self.inside / self.room)


class StoredEnergy(EnergyOfMaterial):
    """Sum of volume at rest times psi."""

    meaning, law = "elastic energy", ENERGY

    def _require(self, kinds: list[type]) -> None:
        unknown = [kind.__name__.removesuffix("Kernel") for kind in kinds if not has_energy(kind)]
        if unknown:
            raise UsageError(f"the energy of {unknown[0]} is not known: its file must call `register_energy`")

    def values(self, track: Track) -> Array:
        out, volume = np.zeros((len(track.F), 1)), self._volume(track)
        for rows, terms, thetas, F, _ in self._pieces(track):
            psi = sum(energy(term, theta, F) for term, theta in zip(terms, thetas, strict=True))
            out[rows, 0] = np.reshape(psi, (-1, len(self.at))) @ volume
        if self.averaging is not None:
            out[:, 0] += self.averaging.values(track) @ volume
        return out

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        volume = self._volume(track)
        F_bar, design_bar = np.zeros(track.F.shape), np.zeros(track.design.shape)
        theta_bars = [np.zeros((len(theta), len(self.at))) for theta in track.terms[self.material.group]]
        for rows, terms, thetas, F, _ in self._pieces(track):
            each = (bar[rows] * volume).ravel()
            total = [0.0 * each for _ in F]
            for term, theta, theta_bar in zip(terms, thetas, theta_bars, strict=True):
                psi = energy(term, theta, F).reshape(-1, len(self.at))
                design_bar[VOLUME, self.members] += bar[rows, 0] @ psi * self.inside / self.room
                by_theta, by_F = energy_vjp(term, theta, F, each)
                theta_bar += _per_particle(by_theta, len(self.at))
                total = [a + b for a, b in zip(total, by_F, strict=True)]
            F_bar[rows] = _matrices(total, track.F[rows].shape)
        if self.averaging is not None:
            by_particle = bar[:, 0] @ self.averaging.values(track)
            design_bar[VOLUME, self.members] += by_particle * self.inside / self.room
        out = TrackBar(F=F_bar, design=design_bar, terms=self._terms_bar(track, theta_bars))
        return self._with_averages(out, track, bar * volume)


class LostEnergy(EnergyOfMaterial):
    """Integral of the volume at rest times tau_v : C, where tau_v = tau(F, C) - tau(F, 0) does work that is lost.

    This holds for every law without a history: its stress at rest is that of its energy. A Kirchhoff stress is
    symmetric, so tau_v : C is tau_v : d.
    """

    meaning, cumulative = "energy dissipated by viscosity", True

    def values(self, track: Track) -> Array:
        power, volume = np.zeros(len(track.F)), self._volume(track)
        for rows, terms, thetas, F, C in self._pieces(track):
            tau = _sum(_viscous(term, theta, F, C) for term, theta in zip(terms, thetas, strict=True))
            power[rows] = inner(tau, C).reshape(-1, len(self.at)) @ volume
        return accumulated(0.5 * track.control_step * (power[:-1] + power[1:]))

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        step_bar = 0.5 * track.control_step * accumulated_vjp(bar)
        power_bar, volume = np.append(step_bar, 0.0) + np.append(0.0, step_bar), self._volume(track)
        F_bar, C_bar, design_bar = np.zeros(track.F.shape), np.zeros(track.C.shape), np.zeros(track.design.shape)
        theta_bars = [np.zeros((len(theta), len(self.at))) for theta in track.terms[self.material.group]]
        for rows, terms, thetas, F, C in self._pieces(track):
            each = np.outer(power_bar[rows], volume).ravel()
            F_piece, C_piece = _zeros(F), _zeros(C)
            for term, theta, theta_bar in zip(terms, thetas, theta_bars, strict=True):
                tau = _viscous(term, theta, F, C)
                by_particle = inner(tau, C).reshape(-1, len(self.at))
                design_bar[VOLUME, self.members] += power_bar[rows] @ by_particle / self.room
                by_theta, by_F, by_C = _viscous_vjp(term, theta, F, C, scale(C, each))
                theta_bar += _per_particle(by_theta, len(self.at))
                F_piece, C_piece = add(F_piece, by_F), add(C_piece, add(by_C, scale(tau, each)))
            F_bar[rows], C_bar[rows] = (_matrices(a, track.F[rows].shape) for a in (F_piece, C_piece))
        return TrackBar(F=F_bar, C=C_bar, design=design_bar, terms=self._terms_bar(track, theta_bars))


def _viscous(term: Any, theta: Any, F: Any, C: Any) -> Any:
    """Return the part tau(F, C) - tau(F, 0) of a term's stress."""
    if not needs_rate(type(term)):
        return _zeros(F)
    return sub(kirchhoff(term, theta, F, C), kirchhoff(term, theta, F, _zeros(C)))


def _viscous_vjp(term: Any, theta: Any, F: Any, C: Any, tau_bar: Any) -> Any:
    """Return (theta_bar, F_bar, C_bar)."""
    if not needs_rate(type(term)):
        return _zeros(theta), _zeros(F), _zeros(C)
    moving, still = (kirchhoff_vjp(term, theta, F, rate, tau_bar) for rate in (C, _zeros(C)))
    by_theta = tuple(a - b for a, b in zip(moving[0], still[0], strict=True))
    return by_theta, sub(moving[1], still[1]), moving[2]


def _zeros(entries: Any) -> Any:
    """Return zeros like a tuple of arrays, also where an entry is not finite."""
    return tuple(np.zeros_like(entry) for entry in entries)


def _entries(field: Array) -> tuple[Array, ...]:
    """Return matrices (T, n, D, D) as a tuple of D * D flat arrays (T * n,)."""
    return tuple(np.ascontiguousarray(field.reshape(-1, field.shape[-1] ** 2).T))


def _matrices(entries: Sequence[Array], shape: tuple[int, ...]) -> Array:
    """Return the adjoint of `_entries`: matrices of a shape (T, n, D, D)."""
    return np.stack(entries, axis=-1).reshape(shape)


def _per_particle(rows: Any, n: int) -> Array:
    """Return cotangents of parameters at all moments, summed over the moments (rows, n)."""
    return np.array([np.reshape(row, (-1, n)).sum(axis=0) for row in rows])


def _sum(parts: Iterator[tuple[Array, ...]]) -> list[Array]:
    """Return the sum of tensors."""
    return [sum(entries[1:], entries[0]) for entries in zip(*parts, strict=True)]
