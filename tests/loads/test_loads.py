"""Every load that the registry knows, and gravity: what it does to particles, and its adjoint."""

from __future__ import annotations

from dataclasses import fields as fields_of
from typing import Any

import numpy as np
import pytest

from cqrun.loads.gravity import Gravity
from cqrun.loads.load import Load
from cqrun.plugin import registry
from cqrun.state import ParticleFields

N, CHOSEN = 7, np.array([1, 2, 5])
KNOWN = {**registry.plugins("load"), "gravity": Gravity}
EVERY = pytest.mark.parametrize("name", KNOWN)
DIM = pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])


def example(name: str, dim: int) -> Load:
    """Return a load with numbers in it; one that is not listed here fails its tests."""
    vector = [1.5, -2.0, 0.7][:dim]
    given: dict[str, Any] = {
        "attached_mass": {"mass": 0.3}, "damping": {"rate": 2.5}, "gravity": {"gravity": vector},
        "point_force": {"force": vector},
    }  # fmt: skip
    return KNOWN[name](**given[name])


def some_fields(dim: int, rng: np.random.Generator) -> ParticleFields:
    """Return fields with a number everywhere."""
    return ParticleFields(*(1.0 + rng.random(shape) for shape in ((N,), (N,), (N,), (N, dim))))


def product(a: ParticleFields, b: ParticleFields) -> float:
    """Return the scalar product of two sets of fields."""
    return float(sum((getattr(a, f.name) * getattr(b, f.name)).sum() for f in fields_of(a)))


def applied(load: Load, fields: ParticleFields, change: ParticleFields | None = None, h: float = 0.0) -> ParticleFields:
    """Return the fields, moved by h change, under a load."""
    moved = ParticleFields(*(getattr(fields, f.name).copy() for f in fields_of(fields)))
    for f in fields_of(fields) if change is not None else ():
        getattr(moved, f.name)[...] += h * getattr(change, f.name)
    load.apply(moved, CHOSEN)
    return moved


@EVERY
@DIM
def test_dot_product(name, dim, rng):
    """By the load's own numbers and by the fields that it reads; all are linear, so a central difference is exact."""
    load, start, bar = example(name, dim), some_fields(dim, rng), some_fields(dim, rng)
    numbers = {k: np.asarray(getattr(load, k), float) for k in ("mass", "rate", "gravity", "force") if hasattr(load, k)}
    by_fields = ParticleFields(*(getattr(bar, f.name).copy() for f in fields_of(bar)))
    by_number = load.apply_vjp(applied(load, start), by_fields, CHOSEN)
    assert set(by_number) == set(numbers)
    for key, value in numbers.items():
        d = rng.normal(size=value.shape)
        ends = [applied(load.model_copy(update={key: (value + h * d).tolist()}), start) for h in (0.5, -0.5)]
        forward = product(ends[0], bar) - product(ends[1], bar)
        assert abs(forward) > 0
        assert np.sum(np.asarray(by_number[key]) * d) == pytest.approx(forward, rel=1e-9)
    change = some_fields(dim, rng)
    forward = product(applied(load, start, change, 0.5), bar) - product(applied(load, start, change, -0.5), bar)
    assert product(by_fields, change) == pytest.approx(forward, rel=1e-9)


@EVERY
@DIM
def test_others_are_left_alone(name, dim, rng):
    start = some_fields(dim, rng)
    after, others = applied(example(name, dim), start), np.setdiff1d(np.arange(N), CHOSEN)
    for field in fields_of(start):
        np.testing.assert_array_equal(getattr(after, field.name)[others], getattr(start, field.name)[others])


@DIM
def test_what_they_add_in_all(dim, rng):
    start = some_fields(dim, rng)
    vector = np.array([1.5, -2.0, 0.7][:dim])
    heavier = applied(example("attached_mass", dim), start)
    assert heavier.mass.sum() - start.mass.sum() == pytest.approx(0.3)
    np.testing.assert_array_equal(heavier.volume, start.volume)
    damped = applied(example("damping", dim), start)
    np.testing.assert_allclose((damped.damping - start.damping)[CHOSEN], 2.5)
    pulled = applied(example("point_force", dim), start)
    np.testing.assert_allclose((pulled.force - start.force).sum(axis=0), vector)
    fallen = applied(example("gravity", dim), start)
    np.testing.assert_allclose((fallen.force - start.force)[CHOSEN], start.mass[CHOSEN, None] * vector)
