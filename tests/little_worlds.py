"""Small models for the engine's tests, all of the same types, so that few kernels are compiled.

A kernel is compiled for the types of its arguments: the dimension, the terms of the stress, the boundary conditions,
the kinds of actuators, the precision. So every model here has all of them. A test switches off those that it does not
need by their numbers: a modulus or a viscosity of zero, a condition without nodes, an actuator without particles.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pytest
from numba import config
from scipy import sparse

from cqrun.actuators import body_force, cable, muscle, pressure, tension
from cqrun.actuators.actuator import Actuator
from cqrun.actuators.muscle import symmetric_rows
from cqrun.boundaries.friction import Friction
from cqrun.boundaries.separate import Separate
from cqrun.boundaries.slip import Slip
from cqrun.boundaries.sticky import Sticky
from cqrun.engine.model import ActuatorModel, ConditionModel, GroupModel, Inputs, Model
from cqrun.engine.setting import grid_shape, node_positions
from cqrun.forces import spring
from cqrun.materials import fixed_corotated, incompressibility, neo_hookean, viscosity
from cqrun.state import Layout, ParticleFields, State, StateField

TERMS = (
    lambda theta: fixed_corotated.FixedCorotatedKernel(theta, (0, 0)),
    lambda theta: neo_hookean.NeoHookeanKernel(theta, (0, 0)),
    lambda theta: viscosity.ViscosityKernel(theta, (0, 0)),
    lambda theta: incompressibility.IncompressibilityKernel(theta, (0, 0), 2),
)
"""The terms of every body, in the order of `Inputs.terms`; active stresses follow."""


class Extra(NamedTuple):
    """One more term of the stress, with a history: what makes its kernels' view, its parameters, its fields."""

    make: Callable[[np.ndarray], Any]
    theta: np.ndarray
    history: tuple[StateField, ...]


CONDITIONS = (Friction,) * 4 + (Slip,) * 3 + (Separate, Sticky)
"""The kinds of boundary condition of every model, in the order of `Inputs.coefficients`."""

STRESSES = (muscle.MuscleKernel, pressure.PressureKernel)
FORCES = (cable.CableKernel, body_force.BodyForceKernel, tension.TensionKernel)
PASSIVE = spring.SpringKernel
"""The kinds of actuators of every model, in the order of `Inputs.activation`, and of forces without an activation."""

needs_jit = pytest.mark.skipif(config.DISABLE_JIT, reason="threads and speed need compiled kernels")
"""Marks a test of threads, or one that would take minutes in plain Python."""


def cases(named: Mapping[str, Any], fast: Collection[str]) -> list[Any]:
    """Return cases as parameters of a fixture or a test; those that are not named as fast are slow tests.

    Each has kernels of its own, which take minutes to compile.
    """
    return [pytest.param(case, marks=() if name in fast else pytest.mark.slow, id=name) for name, case in named.items()]


@dataclass
class Wall:
    """A boundary condition: `kind` is one of CONDITIONS, `nodes` selects the node positions (n, D) that it holds."""

    kind: type
    normal: tuple[float, ...]
    nodes: Callable[[np.ndarray], np.ndarray]
    coefficient: float = 0.0


@dataclass(eq=False)
class Acting:
    """A part of an actuator: `kind` is one of STRESSES or FORCES, `constants` are the constants of its kernel."""

    kind: type
    particles: np.ndarray
    constants: np.ndarray
    rest: float = 0.0

    @classmethod
    def of(cls, spec: Actuator, particles: np.ndarray, x: np.ndarray) -> Acting:
        """Return a plug-in that acts on some of the particles at rest at x (N, D)."""
        particles = np.asarray(particles, np.int64)
        own = x[particles]
        return cls(spec.kernel, particles, spec.constants(own), spec.rest_length(own))


def every_kind(wanted: list[Acting], dim: int) -> tuple[list[Acting], np.ndarray]:
    """Return actuators of all kinds in order, with empty ones for unused kinds, and which were requested (A,)."""
    actuators: list[Acting] = []
    for kind, size in zip((*STRESSES, *FORCES), (dim * (dim + 1) // 2, 1, 1, dim, 0), strict=True):
        of_kind = [a for a in wanted if a.kind is kind]
        actuators += of_kind or [Acting(kind, np.zeros(0, np.int64), np.zeros(size))]
    if [a for a in actuators if a in wanted] != wanted:
        raise ValueError("actuators must be in the order of their kinds")
    return actuators, np.array([a in wanted for a in actuators])


def below(axis: int, level: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return the nodes at or below a level along an axis."""
    return lambda nodes: nodes[:, axis] <= level + 1e-9


def above(axis: int, level: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return the nodes at or above a level along an axis."""
    return lambda nodes: nodes[:, axis] >= level - 1e-9


def conditions(walls: list[Wall], size: np.ndarray, dx: float) -> tuple[tuple[ConditionModel, ...], np.ndarray]:
    """Return one condition for each of CONDITIONS, with the walls among them, and the coefficients."""
    nodes = node_positions(grid_shape(size, dx), dx)
    waiting, models, coefficients = list(walls), [], []
    for kind in CONDITIONS:
        wall = next((w for w in waiting if w.kind is kind), None)
        if wall is not None:
            waiting.remove(wall)
        normal = wall.normal if wall else (1.0,) + (0.0,) * (len(size) - 1)
        held = wall.nodes(nodes) if wall else np.zeros(len(nodes), bool)
        spec = kind(face="x_min", coefficient=0.0) if kind is Friction else kind(face="x_min")
        models.append(ConditionModel(kind.name, spec, tuple(float(a) for a in normal), held))
        coefficients.append(wall.coefficient if wall else 0.0)
    if waiting:
        raise ValueError(f"there is no free place for {waiting}")
    return tuple(models), np.array(coefficients)


def world(
    x: np.ndarray | list[np.ndarray], *, size: list[float], dx: float, dt: float, substeps: int, controls: int,
    mass: Any = 1.0, volume: Any = 1.0, E: Any = 0.0, nu: Any = 0.3, neo_hookean: Any = 0.0, eta: Any = 0.0,
    zeta: Any = 0.0, incompressible: Any = 0.0, extra: Extra | None = None,
    damping: Any = 0.0, gravity: Any = None,
    walls: list[Wall] | None = None, muscles: tuple[tuple[np.ndarray, np.ndarray], ...] = (),
    actuators: tuple[Acting, ...] = (), springs: tuple[Acting, ...] = (),
    activation: np.ndarray | None = None, probe: Any = None,
    real: Any = np.float64, budget: int = 2**30,
) -> tuple[Model, Inputs]:  # fmt: skip
    """Return a model and its inputs for bodies at rest at x (N, D) each.

    Numbers are one for all particles or one each; `neo_hookean` and `incompressible` are the Young's moduli of
    those terms; `muscles` are (particles, direction matrix), `actuators` others after them, in the order of their
    kinds, and `activation` (T, A) is of both; `springs` have none.
    """
    bodies = x if isinstance(x, list) else [x]
    x = np.concatenate(bodies)
    (n, dim), size_ = x.shape, np.asarray(size, float)
    layout = Layout(dim, tuple(len(b) for b in bodies), extra.history if extra else ())
    planes, coefficients = conditions(walls or [], size_, dx)
    wanted = [Acting(muscle.MuscleKernel, np.asarray(p), symmetric_rows(np.asarray(S, float))) for p, S in muscles]
    acting, chosen = every_kind([*wanted, *actuators], dim)
    passive = springs or (Acting(PASSIVE, np.zeros(0, np.int64), np.zeros(0)),)
    parts, more = (
        tuple(ActuatorModel(f"{name} {k}", a.kind, a.particles, a.constants) for k, a in enumerate(of))
        for name, of in (("actuator", acting), ("spring", passive))
    )
    makers = (*TERMS, extra.make) if extra else TERMS
    history = (*((),) * len(TERMS), tuple(f.name for f in extra.history)) if extra else ()
    group = GroupModel(tuple(range(len(bodies))), makers, STRESSES, history)
    model = Model(
        size_, dx, dt, substeps, controls, tuple(f"body {k}" for k in range(len(bodies))), layout,
        (group,), planes, parts,
        None if probe is None else sparse.csr_array(probe), real, budget, more,
    )  # fmt: skip
    fields = ParticleFields.zeros(n, dim)
    fields.mass[:], fields.volume[:], fields.damping[:] = mass, volume, damping
    if gravity is not None:
        fields.force[:] = fields.mass[:, None] * np.asarray(gravity, float)
    pairs = ((E, nu), (neo_hookean, nu), (eta, zeta), (incompressible, nu))
    terms = [np.array([np.broadcast_to(np.asarray(a, float), n) for a in pair]) for pair in pairs]
    terms += [extra.theta] if extra else []
    signals = np.zeros((controls, len(acting)))
    if activation is not None:
        signals[:, chosen] = activation
    rest = np.array([a.rest for a in (*acting, *passive)])
    state = State.at_rest(x, layout.history)
    return model, Inputs(state, fields, [terms], signals, np.ones(len(rest)), coefficients, rest=rest)
