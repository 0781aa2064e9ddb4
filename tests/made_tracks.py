"""Random tracks for objective terms, and the dot-product test of a term by complex step."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from made_matter import CONTROL_STEP, N_ACTUATORS, N_CONTROLS, N_WEIGHTS, made_matter, mismatch, moved, slope

from cqrun.observers.track import Track, TrackBar

FIELDS = ("x", "v", "C", "F", "activation", "design", "held", "strength", "rest_length", "terms", "weights", "rest",
          "friction", "rigid")  # fmt: skip


def a_track(n_rows: int, dim: int, rng: np.random.Generator) -> Track:
    draw = lambda *shape: rng.normal(size=(N_CONTROLS + 1, n_rows, *shape))  # noqa: E731
    goals = {"target": rng.normal(size=dim)}
    activation, design = rng.normal(size=(N_CONTROLS, N_ACTUATORS)), rng.normal(size=(4, made_matter(dim).n_particles))
    motion = 0.3 * draw(dim), draw(dim), draw(dim, dim), draw(dim, dim)
    strength, rest = 2.0 + rng.uniform(size=N_ACTUATORS + 1), 1.0 + 0.2 * rng.uniform(size=N_ACTUATORS + 1)
    n_arm = len(made_matter(dim).members("arm"))
    n_ball = design.shape[1] - n_arm
    terms = [
        [np.array([[2.0], [0.3]]) + 0.05 * rng.uniform(size=(2, n)), np.array([[0.5], [0.2]]) + np.zeros((2, n))]
        for n in (n_arm, n_ball)
    ]
    return Track(
        *motion, activation, goals, CONTROL_STEP, 2.0 + 0.1 * design, a_reaction(dim, rng), strength, rest, terms,
        0.5 + rng.uniform(size=N_WEIGHTS), made_matter(dim).x, np.linspace(0.2, 0.5, N_ACTUATORS + 1),
        {name: rng.normal(size=(N_CONTROLS + 1, 6 if dim == 2 else 12)) for name in ("stone", "jaw")},
    )  # fmt: skip


def a_reaction(dim: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return random forces and moments of two boundaries."""
    return {name: rng.normal(size=(N_CONTROLS + 1, 3 if dim == 2 else 6)) for name in ("clamp", "floor")}


def adjoint_error(value: Any, value_vjp: Any, track: Track, rng: np.random.Generator) -> float:
    """Return the relative error of bar (J d) = (J^T bar) . d."""
    directions = random_directions(track, rng)
    tilted = replace(track, **{name: moved(getattr(track, name), directions[name]) for name in FIELDS})
    bar = rng.normal()
    found = value_vjp(track, bar)
    parts = products_of(found, directions)
    expected = slope(lambda: value(tilted), bar)
    return mismatch(sum(float(p.sum()) for p in parts), expected, sum(float(np.abs(p).sum()) for p in parts))


def products_of(bar: TrackBar, directions: dict[str, Any]) -> list[np.ndarray]:
    """Return the products of a cotangent's numbers with those of the directions."""
    plain = [name for name in FIELDS if name not in ("held", "terms", "rigid")]
    parts = [bar_of(bar, name, directions[name].shape) * directions[name] for name in plain]
    for kind, by_name in bar.by_name.items():
        parts += [part * directions[kind][name] for name, part in by_name.items()]
    for group, along in zip(bar.terms or [], directions["terms"], strict=False):
        parts += [part * direction for part, direction in zip(group, along, strict=True)]
    return parts


def random_directions(track: Track, rng: np.random.Generator) -> dict[str, Any]:
    """Return random numbers in the form of each of a track's fields; those of friction have a source of their own."""
    own = {"friction": rng.spawn(1)[0]}
    return {name: random_like(getattr(track, name), own.get(name, rng)) for name in FIELDS}


def random_like(value: Any, rng: np.random.Generator) -> Any:
    """Return random numbers in the form of an array, or of a mapping of arrays."""
    if isinstance(value, dict):
        return {name: rng.normal(size=each.shape) for name, each in value.items()}
    if isinstance(value, list):
        return [random_like(each, rng) for each in value]
    return rng.normal(size=value.shape)


def bar_of(bar: TrackBar, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return a cotangent, None as zeros; one of another shape than its value's is an error."""
    own = getattr(bar, name)
    assert own is None or own.shape == shape, name
    return np.zeros(shape) if own is None else own
