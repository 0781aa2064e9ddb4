"""Two bodies with everything switched on, each boundary at work, and random numbers wherever a gradient goes."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from little_worlds import TERMS, Acting, Wall, above, below, world

from cqrun.actuators import body_force, cable, pressure, tension
from cqrun.boundaries.friction import Friction
from cqrun.boundaries.separate import Separate
from cqrun.boundaries.slip import Slip
from cqrun.boundaries.sticky import Sticky
from cqrun.engine.model import Inputs, Model, Records
from cqrun.forces import spring
from cqrun.state import State

DX = 0.1
COUNTS = (17, 30)
"""Particles of the two bodies: neither a whole number of lanes."""


def walls(dim: int) -> list[Wall]:
    """Return a floor and a slope with friction, a slipping and a separating wall, and clamped nodes."""
    up, diagonal = np.eye(dim)[-1], (np.eye(dim)[0] + np.eye(dim)[-1]) / np.sqrt(2)
    found = [
        Wall(Friction, tuple(up), below(dim - 1, 0.2), 0.4),
        Wall(Friction, tuple(diagonal), lambda nodes: nodes[:, 0] + nodes[:, -1] <= 0.41, 1.5),
        Wall(Slip, tuple(np.eye(dim)[0]), below(0, 0.1)),
        Wall(Separate, tuple(-np.eye(dim)[0]), above(0, 0.7)),
        Wall(Sticky, (0.0,) * dim, lambda nodes: (nodes[:, -1] >= 0.5) & (nodes[:, 0] >= 0.6)),
    ]
    if dim == 3:
        found.append(Wall(Friction, (0.0, 1.0, 0.0), below(1, 0.2), 0.3))
    return found


def tendons(x: np.ndarray) -> tuple[Acting, ...]:
    """Return a chamber in each body, three cables, two body forces and two cables whose tension is given.

    The cables start taut by a seventh, slack by a seventh, and with a negative signal; one ties the bodies. One of the
    others pulls, and one is slack.
    """
    first, both = np.arange(COUNTS[0]), np.arange(len(x))
    routes = ([0, 5, 9, 12], [20, 31, 40], [3, 44])
    ways = np.eye(x.shape[1])[0], np.ones(x.shape[1])
    return (
        Acting(pressure.PressureKernel, both[COUNTS[0] :: 2], np.ones(1)),
        Acting(pressure.PressureKernel, both[::4], np.ones(1)),
        *(Acting(cable.CableKernel, np.array(r), np.zeros(0), length(x[r])) for r in routes),
        Acting(body_force.BodyForceKernel, first, ways[0]),
        Acting(body_force.BodyForceKernel, both[5::3], ways[1]),
        *(Acting(tension.TensionKernel, np.array(r), np.zeros(0)) for r in ([1, 6, 13], [21, 35])),
    )


def springs(x: np.ndarray) -> tuple[Acting, ...]:
    """Return a stretched spring and a compressed one, which ties the bodies."""
    routes = ([2, 7, 9], [6, 33])
    kernel, none = spring.SpringKernel, np.zeros(0)
    return tuple(Acting(kernel, np.array(r), none, f * length(x[r])) for r, f in zip(routes, (0.9, 1.1), strict=True))


def length(route: np.ndarray) -> float:
    """Return the length of a route through points (r, D)."""
    return float(np.sqrt((np.diff(route, axis=0) ** 2).sum(axis=1)).sum())


STIFFNESS = {2: 0.2, 3: 0.01}
"""Of cables by dimension [N/m]: they pull as hard as the body is heavy."""

ACTUATORS = {"muscle": slice(0, 2), "pressure": slice(2, 4), "cable": slice(4, 7), "body_force": slice(7, 9),
             "tension": slice(9, 11)}  # fmt: skip
"""Where the actuators of each kind stand."""

SPRINGS = slice(11, 13)
"""Where the springs stand among all parts."""


def signals(controls: int, rng: np.random.Generator) -> np.ndarray:
    """Return activations (T, 11): the first cable stays taut, the second slack, the third fully reeled in.

    Of the cables whose tension is given, the first pulls and the second is slack.
    """
    out = rng.normal(size=(controls, 11)) * 0.5
    out[:, ACTUATORS["tension"]] = np.array([0.6, -0.3]) + 0.2 * rng.random((controls, 2))
    out[:, ACTUATORS["cable"]] = np.array([0.85, 1.15, -0.2]) + 0.05 * rng.random((controls, 3))
    return out


def rich(dim: int, *, substeps: int = 4, controls: int = 3, seed: int = 0, **options: Any) -> tuple[Model, Inputs]:
    """Return the model and its inputs; `options` go to `world`."""
    rng = np.random.default_rng(seed)
    low, high = np.full(dim, 0.22), np.full(dim, 0.52)
    low[0], high[0] = 0.12, 0.4
    bodies = [low + rng.random((COUNTS[0], dim)) * (high - low)]
    low[0], high[0] = 0.42, 0.68
    bodies.append(low + rng.random((COUNTS[1], dim)) * (high - low))
    n = sum(COUNTS)
    volume = 0.05**dim * rng.uniform(0.8, 1.2, n)
    mass = volume * rng.uniform(0.8, 1.2, n)
    x = np.concatenate(bodies)
    axis, oblique = np.diag(np.eye(dim)[-1]), np.full((dim, dim), 0.3)
    model, inputs = world(
        bodies, size=[0.9] * dim, dx=DX, dt=4e-3, substeps=substeps, controls=controls, mass=mass, volume=volume,
        E=rng.uniform(8, 12, n), nu=rng.uniform(0.2, 0.4, n), neo_hookean=rng.uniform(2, 3, n),
        eta=rng.uniform(0.01, 0.02, n), zeta=rng.uniform(0.01, 0.02, n), incompressible=rng.uniform(1, 2, n),
        springs=springs(x),
        damping=rng.random(n), muscles=((np.arange(0, n, 3), axis), (np.arange(0, n, 2), oblique)),
        actuators=tendons(x), activation=signals(controls, rng), walls=walls(dim), probe=rng.random((3, n)) / n,
        **options,
    )  # fmt: skip
    s = inputs.state
    s.v = rng.normal(size=s.x.shape) * 0.3
    s.v[:, -1] -= 1.0
    s.v[:, 0] += np.where(np.arange(n) < COUNTS[0], -0.5, 0.5)
    s.C, s.F = rng.normal(size=s.C.shape) * 0.2, s.F + rng.normal(size=s.F.shape) * 0.05
    s.memory = rng.normal(size=4)
    inputs.strength[:11] = rng.uniform(0.8, 1.2, 11)
    inputs.strength[SPRINGS] = 0.2 * STIFFNESS[dim]
    inputs.strength[ACTUATORS["cable"]] *= STIFFNESS[dim]
    inputs.strength[ACTUATORS["tension"]] *= 0.1 * STIFFNESS[dim]
    inputs.fields.force[:] = mass[:, None] * rng.normal(size=s.x.shape)
    inputs.weights = rng.uniform(0.5, 1.5, model.weight_slices[-1].stop)
    for strain in s.history.values():
        strain += 0.05 * rng.normal(size=n)
    return model, inputs


KINDS = (
    "x", "v", "C", "F", "mass", "volume", "damping", "force", "fixed_corotated.E", "fixed_corotated.nu",
    "neo_hookean.E", "neo_hookean.nu", "viscosity.shear", "viscosity.bulk", "incompressibility.E",
    "incompressibility.nu", "friction",
    *(f"{kind}.{what}" for kind in ACTUATORS for what in ("activation", "strength")),
    "weights", "cable.rest", "spring.strength", "spring.rest",
)  # fmt: skip
"""What a rollout depends on, in the order of `arrays`."""


def arrays(inputs: Inputs) -> list[np.ndarray]:
    """Return the arrays of inputs or of a cotangent, views where they are rows, one for each of KINDS."""
    s, f = inputs.state, inputs.fields
    terms = [row for theta in inputs.terms[0][: len(TERMS)] for row in theta]
    drive = [a for at in ACTUATORS.values() for a in (inputs.activation[:, at], inputs.strength[at])]
    fields, last = [f.mass, f.volume, f.damping, f.force], [inputs.weights, inputs.rest[ACTUATORS["cable"]]]
    last += [inputs.strength[SPRINGS], inputs.rest[SPRINGS]]
    return [s.x, s.v, s.C, s.F, *fields, *terms, inputs.coefficients, *drive, *last]


def direction(inputs: Inputs, kind: str, rng: np.random.Generator) -> np.ndarray:
    """Return a random direction of one kind of input, of the size of its values, or of a cell for positions."""
    value = arrays(inputs)[KINDS.index(kind)]
    size = np.abs(value) if kind != "x" else 0.1 * DX
    return rng.normal(size=value.shape) * np.maximum(size, 0.1 * np.abs(value).max() if kind != "x" else 0.0)


def moved(inputs: Inputs, kind: str, change: np.ndarray) -> Inputs:
    """Return inputs with one kind moved, complex where the change is."""
    other = copy.deepcopy(inputs)
    if np.iscomplexobj(change):
        make_complex(other)
    arrays(other)[KINDS.index(kind)][...] += change
    return other


def make_complex(inputs: Inputs) -> None:
    """Turn every array of the inputs complex."""
    for part in (inputs.state, inputs.fields):
        for name, value in vars(part).items():
            if name == "history":
                value.update({field: a.astype(complex) for field, a in value.items()})
            else:
                setattr(part, name, value.astype(complex))
    inputs.terms = [[theta.astype(complex) for theta in group] for group in inputs.terms]
    for name in ("activation", "strength", "coefficients", "weights", "rest"):
        setattr(inputs, name, getattr(inputs, name).astype(complex))


def random_records(records: Records, rng: np.random.Generator) -> Records:
    """Return random cotangents of records."""
    return rebuilt(records, [rng.normal(size=a.shape) for a in parts(records)])


def random_state(state: State, rng: np.random.Generator) -> State:
    """Return random cotangents of a state."""
    return replace(
        rebuilt(state, [rng.normal(size=a.shape) for a in parts(state)]), memory=rng.normal(size=state.memory.shape)
    )


def rebuilt(like: Any, arrays: list[np.ndarray]) -> Any:
    """Return a state or records with other arrays, in the order of `parts`."""
    return replace(
        like,
        x=arrays[0],
        v=arrays[1],
        C=arrays[2],
        F=arrays[3],
        history=dict(zip(like.history, arrays[4:], strict=True)),
    )


def parts(a: Any) -> Iterator[np.ndarray]:
    """Return x, v, C, F and the histories of a state, of records, or of the reference's state."""
    return iter((a.x, a.v, a.C, a.F, *a.history.values()))


def product(a: Any, b: Any) -> Any:
    """Return the scalar product of two states or two records."""
    return sum((p * q).sum() for p, q in zip(parts(a), parts(b), strict=True))
