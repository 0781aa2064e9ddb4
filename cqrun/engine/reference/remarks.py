"""What a user should know of deformations: a substep that is too long, material that is inverted, bodies pulled far.

The substep must be short enough for the fastest wave (materials/waves.py). So a squeezed neo-Hookean body needs shorter
substeps, but a fixed corotated one only if it is stretched. LIMIT was
measured by power iteration on bodies with the same F everywhere: the largest stable substep was 1.08 to 1.22 of that
time, at stretches from 0.3 to 3, for both laws with nu 0.3 and 0.45; 1.22 where one direction is much stiffer, as it is
where this matters.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from cqrun.engine.reference.stretch import COLUMN, FIRST, LEAST, MATRIX, MOST, STEP, VALUE, VOLUME
from cqrun.engine.suspects import driver_at, place_of
from cqrun.materials.waves import wave_stiffness
from cqrun.plugin.contract import Array

ReferenceRollout = Any
"""A rollout of rollout.py, which imports this file."""

LIMIT = 1.2
"""Largest stable substep, in times in which a wave crosses a cell of the material as it is deformed."""

LONGER = 1.1
"""Stretch from which a body counts as stretched."""

FAR = 5.0
"""Stretch from which a body is asked whether it should have torn."""

WILDEST = 100.0
"""Volume ratio below zero from which a run has blown up."""


class Noted(NamedTuple):
    """A particle that was deformed much: its body, when, its principal stretches in order, and the substeps needed.

    `place` has its body and group as text, and `driver` a sentence about an actuator that deforms it, or nothing.
    """

    body: str
    time: float
    stretches: Array
    substeps: int
    place: str
    driver: str

    def __str__(self) -> str:
        """Say how it was deformed."""
        least, most = self.stretches[0], self.stretches[-1]
        how = f"squeezed to {least:.2f} of its length"
        if most > LONGER:
            thinned = f" and thinned to {least:.2f} across" if least < 1.0 / LONGER else ""
            how = f"stretched to {most:.2f} times its length{thinned}"
        return f"{self.place} was {how} at t = {self.time:.4g} s"


def remarks_on(rollout: ReferenceRollout) -> Iterator[str]:
    """Yield a sentence on each thing that a user should know."""
    needs = max(_noted(rollout), key=lambda each: each.substeps, default=None)
    if needs is not None and needs.substeps > rollout.model.substeps:
        yield (
            f"{needs}, where waves are so fast that the substep is too long to be sure of the motion: set"
            f" time.substeps={needs.substeps}"
        )
    yield from _inverted(rollout)
    yield from _pulled(rollout, FAR)


def why_it_failed(rollout: ReferenceRollout) -> str:
    """Return what led to values that are not finite, as far as it was seen, and the substeps to try."""
    seen = [*remarks_on(rollout)]
    seen += [sentence for sentence in _pulled(rollout, 0.5 * FAR) if sentence not in seen]
    if not any("time.substeps=" in sentence or "the actuator" in sentence for sentence in seen):
        seen.append(f"try time.substeps={2 * rollout.model.substeps}, a softer material or weaker actuation")
    return "; ".join(seen)


def most_stretched(rollout: ReferenceRollout) -> int:
    """Return the particle that was stretched most before a run blew up; -1 if none was seen."""
    column = int(rollout.bundle.least[MOST, COLUMN])
    return -1 if column < 0 else int(rollout.model.layout.sources()[column])


def _pulled(rollout: ReferenceRollout, far: float) -> Iterator[str]:
    """Yield a question about the body that is stretched most, if it is stretched beyond `far`."""
    most = max(_noted(rollout), key=lambda each: float(each.stretches[-1]), default=None)
    if most is not None and most.stretches[-1] > far:
        if most.driver:
            yield f"{most}: {most.driver}"
            return
        yield (
            f"{most}: bodies of the reference frame do not tear; if '{most.body}' should, use `world.frame: updated`"
        )


def _inverted(rollout: ReferenceRollout) -> Iterator[str]:
    row, dt = rollout.bundle.least[VOLUME], rollout.model.dt
    if row[FIRST] >= 0:
        place = place_of(rollout.model, int(rollout.model.layout.sources()[int(row[COLUMN])]))
        # what a run that blew up has in the end says nothing
        least = f", to a volume ratio of J = {row[VALUE]:.2g} at t = {row[STEP] * dt:.4g} s" * bool(
            row[VALUE] > -WILDEST
        )
        yield (
            f"{place} is inverted from t = {row[FIRST] * dt:.4g} s on: its material is turned inside out{least}, which"
            " is not physical; load it less or more slowly, or use a law that resists it (`neo_hookean`), a finer grid"
            " or smaller substeps"
        )


def _noted(rollout: ReferenceRollout) -> list[Noted]:
    """Return the particle with the least principal stretch, and the one that was stretched most; none if unknown."""
    found, dim = [], rollout.model.dim
    for row in rollout.bundle.least[[LEAST, MOST]]:
        if row[COLUMN] >= 0:
            F = row[MATRIX : MATRIX + dim * dim].reshape(dim, dim)
            stretches, k = np.linalg.svd(F, compute_uv=False)[::-1], _body_of(rollout, int(row[COLUMN]))
            particle = int(rollout.model.layout.sources()[int(row[COLUMN])])
            limit = _limit(rollout, k, particle, F)
            substeps = 0 if limit <= 0 else int(np.ceil(rollout.model.substeps * rollout.model.dt / limit))
            time, J = row[STEP] * rollout.model.dt, float(np.linalg.det(F))
            driver = driver_at(rollout.model, particle, J, rollout.activation_at(int(row[STEP])))
            place = place_of(rollout.model, particle)
            found.append(Noted(rollout.model.body_names[k], time, stretches, substeps, place, driver))
    return found


def _body_of(rollout: ReferenceRollout, column: int) -> int:
    particle = int(rollout.model.layout.sources()[column])
    return next(k for k, part in enumerate(rollout.model.layout.slices()) if particle < part.stop)


def _limit(rollout: ReferenceRollout, body: int, particle: int, F: Array) -> float:
    """Return the largest stable substep for one particle at F [s]; infinite without stiffness."""
    model, fields = rollout.model, rollout.inputs.fields
    g = next(g for g, each in enumerate(model.groups) if body in each.bodies)
    thetas = [theta[:, [particle - model.group_slices()[g].start]] for theta in rollout.inputs.terms[g]]
    terms = [make(theta) for make, theta in zip(model.groups[g].kernel_terms, thetas, strict=True)]
    q = wave_stiffness(terms, [theta[:, 0] for theta in thetas], F)
    density = fields.mass[particle] / fields.volume[particle]
    return float(LIMIT * model.dx * np.sqrt(density / q)) if q > 0 else float("inf")
