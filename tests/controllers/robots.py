"""The rich scene as a robot, with every kind of observer and a controller that drives all actuators."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import reference
from made_encoders import made_encoder
from rich_scene import ACTUATORS, COUNTS, make_complex, product, random_records, random_state, rich
from scipy import sparse

from cqrun.controllers.controller import Controller
from cqrun.controllers.policy import ControlPolicy, Limits
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import Inputs, LossBar, Model, Records
from cqrun.engine.rollout import Rollout
from cqrun.observers.centroids import Centroids
from cqrun.observers.clock import Clock
from cqrun.observers.clusters import Clusters
from cqrun.observers.goal import Goal
from cqrun.observers.matter import Matter
from cqrun.observers.observer import BoundObserver, Moment, MomentBar, Observation
from cqrun.observers.pca import Pca, fit_components
from cqrun.observers.rows import means
from cqrun.observers.strain import Strain
from cqrun.observers.vae import Vae
from cqrun.state import State

TINY = 1e-30
GOALS = {"target": np.array([0.5, 0.6, 0.4])}


class Everything(BoundObserver):
    """Two numbers from the whole state: an observer that reads all particles."""

    size, n_memory, needs_state = 2, 0, True

    def __init__(self, n: int, dim: int, rng: np.random.Generator) -> None:
        self.rows, self.low, self.high = means([], n), np.full(2, -1.0), np.full(2, 1.0)
        shapes = {"x": (2, n, dim), "v": (2, n, dim), "C": (2, n, dim, dim), "F": (2, n, dim, dim)}
        self.weights = {name: rng.normal(size=shape) / n for name, shape in shapes.items()}

    def observe(self, moment: Moment) -> tuple[np.ndarray, np.ndarray]:
        return np.sin(self._sum(moment.state())), np.zeros(0)

    def observe_vjp(self, moment: Moment, z_bar: np.ndarray, memory_next_bar: np.ndarray) -> MomentBar:
        sum_bar = z_bar * np.cos(self._sum(moment.state()))
        parts = (np.tensordot(sum_bar, w, 1) for w in self.weights.values())
        return MomentBar(state=State(*parts))

    def _sum(self, state: State) -> np.ndarray:
        return sum((w * getattr(state, name)).reshape(2, -1).sum(axis=1) for name, w in self.weights.items())


def matter_of(model: Model, inputs: Inputs) -> Matter:
    """Return the matter of a rich scene: two bodies, the second one with groups."""
    x, dim = inputs.state.x, model.dim
    bodies = {"first": slice(0, COUNTS[0]), "second": slice(COUNTS[0], len(x))}
    groups = {"low": np.arange(17, 30), "high": np.arange(30, 47)}

    def select(body: str | None, region: Any) -> np.ndarray:
        return np.arange(len(x)) if body is None else np.arange(len(x))[bodies[body]]

    return Matter(
        x, inputs.fields.mass, model.size, model.substeps * model.dt, model.n_controls, bodies,
        {"first": {}, "second": groups}, select, {"target": dim}, len(model.actuators),
    )  # fmt: skip


def observation_of(matter: Matter, rng: np.random.Generator) -> Observation:
    """Return an observation with every kind of observer, with and without memory."""
    dim, second = matter.dim, matter.members("second")
    axis, motion = [1.0, 2.0, -1.0][:dim], ["position", "velocity", "acceleration"]
    shapes = matter.x[second] + 0.1 * rng.normal(size=(5, len(second), dim))
    bound: dict[str, BoundObserver] = {
        "parts": Centroids(body="second", of=motion).bind(matter),
        "clusters": Clusters(body="first", count=2, of=["acceleration", "position"], range=None).bind(matter),
        "strain": Strain(body="second").bind(matter),
        "stretch": Strain(body="first", axis=axis, range=[-0.5, 0.5]).bind(matter),
        "clock": Clock(period=0.05, harmonics=2).bind(matter),
        "time": Clock().bind(matter),
        "goal": Goal(goal="target", body="second", group="high").bind(matter),
        "place": Goal(goal="target").bind(matter),
        "shape": Pca(body="second", components=2).bind_to(matter, fit_components(shapes, 3)),
        "everything": Everything(matter.n_particles, dim, rng),
        "cells": Vae(body="second", file="made here").bind_to(matter, made_encoder(dim, np.random.default_rng(3))),
    }
    return Observation(bound, matter.n_particles)


def limits_of(*, slow: bool) -> Limits:
    """Return the limits of the rich scene's actuators; `slow` ones of each kind have a rate."""
    low, change, neutral = np.full(11, -1.0), np.full(11, np.inf), np.full(11, 0.07)  # no kink
    low[ACTUATORS["pressure"]] = low[ACTUATORS["cable"]] = 0.0
    low[ACTUATORS["tension"]] = -0.8  # a controller whose neurons are silent gives the middle: 0 would be a kink
    neutral[ACTUATORS["cable"]] = 0.45
    low[ACTUATORS["tension"]] = -0.9  # so that the middle, where a silent network is, is not 0, where a cable slackens
    if slow:
        change[[0, 2, 4, 6, 8, 10]] = (0.05, 0.02, 0.03, 10.0, 0.1, 0.04)
    return Limits(low, np.ones(11), change, neutral)


@dataclass
class Robot:
    """A rollout's model and inputs, its policy's parts, and cotangents of its results."""

    model: Model
    inputs: Inputs
    observation: Observation
    controller: Controller
    parameters: dict[str, np.ndarray]
    limits: Limits
    bars: dict[str, Any] = field(default_factory=dict)

    def policy(self, parameters: Mapping[str, np.ndarray] | None = None) -> ControlPolicy:
        """Return the policy of one rollout, with these parameters or the robot's."""
        goals = {name: value[: self.model.dim] for name, value in GOALS.items()}
        step = self.model.substeps * self.model.dt
        chosen = self.parameters if parameters is None else parameters
        return ControlPolicy(self.observation, self.controller, chosen, self.limits, goals, step, self.model.dim)

    def gradient(self, *, threads: int = 1, states: int | None = None) -> tuple[Rollout, Records, Inputs]:
        """Return the rollout, its records and the gradient; `states` is the memory budget in states."""
        rollout = self.rollout(threads=threads, states=states)
        return (rollout, *rollout.gradient(lambda records, state: self.loss_bar))

    @property
    def loss_bar(self) -> LossBar:
        """The cotangents of the rollout's results."""
        return LossBar(self.bars["records"], self.bars["state"], self.bars["activation"])

    def rollout(self, *, threads: int = 1, states: int | None = None) -> Rollout:
        """Return the rollout, ready for a gradient."""
        model = self.model
        if states is not None:
            model = replace(model, memory_budget=states * 2 * model.dim * (1 + model.dim) * model.layout.n * 8)
        return make_rollout(model, self.inputs, threads=threads, adjoint=True, policy=self.policy())

    def derivative(self, inputs: Inputs, parameters: Mapping[str, np.ndarray]) -> float:
        """Return the derivative along the imaginary parts of inputs or parameters, by complex step."""
        turned = copy.deepcopy(inputs)
        make_complex(turned)
        records, last, _ = reference.rollout(self.model, turned, self.policy(parameters))
        total = product(records, self.bars["records"]) + product(last, self.bars["state"])
        total += (turned.activation * self.bars["activation"]).sum()
        total += (turned.state.memory * self.bars["state"].memory).sum()
        return float(total.imag / TINY)


def make_robot(
    controller: Controller, dim: int = 2, *, slow: bool = True, controls: int = 6, substeps: int = 3
) -> Robot:
    """Return a robot with random cotangents of all results of its rollout."""
    rng = np.random.default_rng(11)
    model, inputs = rich(dim, controls=controls, substeps=substeps)
    observation = observation_of(matter_of(model, inputs), rng)
    rows = sparse.vstack([observation.rows, model.probe]).tocsr()
    model, limits = replace(model, probe=sparse.csr_array(rows)), limits_of(slow=slow)
    blocks = controller.blocks(observation.size, 11, controls, limits.low, limits.high, limits.neutral, rng)
    made = Robot(model, inputs, observation, controller, {b.name: b.initial.copy() for b in blocks}, limits)
    inputs.state.memory = made.policy().memory
    made.bars = {
        "records": random_records(Records.zeros(controls, rows.shape[0], dim), rng),
        "state": random_state(inputs.state, rng),
        "activation": rng.normal(size=(controls, 11)),
    }
    return made
