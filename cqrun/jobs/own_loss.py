"""A loss of one's own: any function of a motion, with its gradient by the numbers of a scene.

    problem = cqrun.load("scenes/control/finger.yaml")
    gradient = problem.vjp(x_bar=bar)                          # the cotangent of all positions, from your own code
    loss = problem.loss(miss, backend="torch")                 # def miss(tip, time): ... return a scalar
    value, gradient = loss.value_and_grad({"controller.weights": weights})

The function gets arrays by the names of its arguments: a quantity of the section `measure`, or one of `MOTION`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from cqrun.build.measures import bound_measures
from cqrun.build.model import Built
from cqrun.engine.model import LossBar, Model, Records
from cqrun.engine.rollout import Rollout
from cqrun.errors import UsageError
from cqrun.explain import listed, shown, suggest
from cqrun.jobs.autograd import BACKENDS, Function, differentiated, real
from cqrun.jobs.given_values import Values
from cqrun.learning.agent import CONTROLLER, Agent
from cqrun.observers.rows import single, slices, stacked
from cqrun.observers.track import Track, TrackBar
from cqrun.optimizers.base import one_blas_thread
from cqrun.plugin.contract import Array

MOTION = {
    "x": "positions of all particles (T+1, N, D) [m]",
    "v": "their velocities (T+1, N, D) [m/s]",
    "F": "their deformation gradients (T+1, N, D, D)",
    "activation": "activations of the actuators' parts (T, A)",
    "time": "times of the control steps 0 .. T (T+1,) [s]",
}
"""What a function can ask for beside measured quantities."""


class Runs(Protocol):
    """A scene as a function of its numbers (`cqrun.load`), as far as a loss needs it."""

    built: Built
    agent: Agent | None

    def stable_values(self, params: Values | None) -> dict[str, Array]:
        """Return all values by key path."""

    def chosen_goals(self, goals: Mapping[str, Any] | None) -> dict[str, Array]:
        """Return all goals."""

    def rollout_of(
        self, values: dict[str, Array], goals: Mapping[str, Array], *, model: Model | None = None, adjoint: bool = False
    ) -> Rollout:
        """Return a rollout that has not run yet."""

    def with_followers(self, gradient: dict[str, Array], params: Values | None) -> dict[str, Any]:
        """Return a gradient with the parts of followers added to their unknowns."""


class Call(NamedTuple):
    """One rollout of a problem: its values by key path, and its goals."""

    rollout: Rollout
    values: dict[str, Array]
    goals: dict[str, Array]


class OwnLoss:
    """A function of a problem's motion as a function of the problem's numbers.

    Args:
        problem: the problem.
        function: returns the loss for the arrays that its arguments name. With the backend `numpy` it returns
            (loss, {name: derivative by this array}); with `torch` and `jax` it returns a scalar of these packages.
        of: names of the arrays, in the order of the arguments; the arguments' own names if not given.
        backend: numpy, torch or jax.

    Raises:
        UsageError: a name is not known, or the package of the backend is missing.
    """

    def __init__(
        self, problem: Runs, function: Callable[..., Any], of: Sequence[str] | None = None, backend: str = "numpy"
    ) -> None:
        if backend not in BACKENDS:
            near = suggest(backend, BACKENDS)
            raise UsageError(f"loss: there is no backend '{backend}'{near}; there are {listed(BACKENDS)}")
        self.problem, self.names = problem, _named(function, of)
        self._function = differentiated(function, self.names, backend)
        self._recorded = Recorded(problem, self.names)

    def __call__(self, params: Values | None = None, goals: Mapping[str, Any] | None = None) -> float:
        """Return the loss; the arguments and errors are those of `value_and_grad`."""
        call = self._recorded.call(params, goals, adjoint=False)
        with one_blas_thread():
            records = call.rollout.run()
        return self._function(self._recorded.arrays(call, records))[0]

    def value_and_grad(
        self, params: Values | None = None, goals: Mapping[str, Any] | None = None
    ) -> tuple[float, dict[str, Any]]:
        """Return the loss and its gradient.

        Args:
            params: values by key path, as for `Experiment.value_and_grad`.
            goals: goal -> its entries [m]; a missing goal is in the middle of its range.

        Returns:
            The loss; and its derivatives by every unknown, every parameter of the controller and every number in
            `params`, in the shape of the value.

        Raises:
            UsageError: a path, a goal or a shape is wrong, or the function returns something else than it must.
            RolloutError: the scene blows up.
        """
        return self._recorded.gradient(self._function, params, goals)

    def __repr__(self) -> str:
        return f"<loss of {', '.join(self.names)}>"


def vjp(
    problem: Runs, params: Values | None, bars: Mapping[str, Array], goals: Mapping[str, Any] | None
) -> dict[str, Any]:
    """Return the gradient of sum(bar * array) over the arrays of a motion; see `Experiment.vjp`."""
    recorded = Recorded(problem, tuple(bars))

    def product(arrays: Mapping[str, Array]) -> tuple[float, dict[str, Array]]:
        for name, bar in bars.items():
            if np.shape(bar) != arrays[name].shape:
                raise UsageError(f"vjp: {name} has the shape {np.shape(bar)}; its array has {arrays[name].shape}")
        return 0.0, {name: real(name, bar) for name, bar in bars.items()}

    return recorded.gradient(product, params, goals)[1]


@dataclass
class Recorded:
    """Rollouts of a problem that record what some arrays of the motion need.

    Args:
        problem: the problem.
        names: names of the arrays.
    """

    problem: Runs
    names: tuple[str, ...]

    def __post_init__(self) -> None:
        built, agent = self.problem.built, self.problem.agent
        known = {**MOTION, **built.scene.measure}
        for name in self.names:
            if name not in known:
                raise UsageError(
                    f"there is no '{name}' in a motion{suggest(name, known)}; there are {listed(MOTION)}, and the "
                    f"quantities of `measure`: {listed(built.scene.measure) or 'none'}"
                )
        self.measures = {name: m for name, m in bound_measures(built).items() if name in self.names}
        self.base = built.model if agent is None else agent.model
        n = len(built.particles.x)
        rows = [measure.rows for measure in self.measures.values()]
        if any(name in self.names for name in ("x", "v", "F")):
            rows.append(single(np.arange(n), n))
        before = [] if self.base.probe is None else [self.base.probe]
        places = slices([part.shape[0] for part in (*before, *rows)])[len(before) :]
        self.places = dict(zip(self.measures, places, strict=False))
        self.everything = places[-1] if places else slice(0, 0)  # the rows of all particles, if they are recorded
        self.model = replace(self.base, probe=stacked([*before, *rows], n))

    def call(self, params: Values | None, goals: Mapping[str, Any] | None, *, adjoint: bool) -> Call:
        """Return a rollout that has not run yet."""
        values, chosen = self.problem.stable_values(params), self.problem.chosen_goals(goals)
        return Call(self.problem.rollout_of(values, chosen, model=self.model, adjoint=adjoint), values, chosen)

    def arrays(self, call: Call, records: Records) -> dict[str, Array]:
        """Return the arrays of a motion by name."""
        found: dict[str, Array] = {}
        for name in self.names:
            if name in self.measures:
                found[name] = self.measures[name].values(self._track(name, call, records))
            elif name == "activation":
                found[name] = call.rollout.activation.copy()
            elif name == "time":
                found[name] = self.problem.built.scene.time.control_step * np.arange(len(records.x))
            else:
                found[name] = getattr(records, name)[:, self.everything]
        return found

    def gradient(
        self, function: Function, params: Values | None, goals: Mapping[str, Any] | None
    ) -> tuple[float, dict[str, Any]]:
        """Return a function of the arrays, and its gradient by key path."""
        call = self.call(params, goals, adjoint=True)
        value, beside = 0.0, TrackBar()

        def loss_bar(records: Records, final: Any) -> LossBar:
            nonlocal value
            arrays = self.arrays(call, records)
            value, bars = function({name: array.copy() for name, array in arrays.items()})
            return self._bars(call, records, _known(arrays, bars), beside)

        with one_blas_thread():
            _, inputs_bar = call.rollout.gradient(loss_bar)
        assembly = self.problem.built.assembly
        assembly.add_beside(inputs_bar, beside)
        of_scene = {path: value for path, value in call.values.items() if not path.startswith(CONTROLLER)}
        gradient = assembly.gradient(of_scene, inputs_bar)
        gradient |= {CONTROLLER + name: bar for name, bar in (call.rollout.parameters_bar or {}).items()}
        return value, self.problem.with_followers(gradient, params)

    def _track(self, name: str, call: Call, records: Records) -> Track:
        at, inputs = self.places[name], call.rollout.inputs
        return Track(
            records.x[:, at], records.v[:, at], records.C[:, at], records.F[:, at], call.rollout.activation, call.goals,
            self.problem.built.scene.time.control_step, self.problem.built.assembly.design(inputs), records.held,
            inputs.strength, inputs.rest, inputs.terms, inputs.weights, inputs.state.x,
            inputs.friction, records.rigid,
        )  # fmt: skip

    def _bars(self, call: Call, records: Records, bars: Mapping[str, Array], beside: TrackBar) -> LossBar:
        """Return the cotangents of a rollout's results, and add those of its inputs to `beside`."""
        full, activation_bar = records.zeros_like(), np.zeros(call.rollout.activation.shape)
        for name, bar in bars.items():
            if name in self.measures:
                measure, at = self.measures[name], self.places[name]
                part = measure.values_vjp(self._track(name, call, records), bar)
                for field in ("x", "v", "C", "F"):
                    if getattr(part, field) is not None:
                        getattr(full, field)[:, at] += getattr(part, field)
                full.add_by_name(part.by_name)
                activation_bar += 0.0 if part.activation is None else part.activation
                beside.add_inputs_of(part)
            elif name == "activation":
                activation_bar += bar
            elif name != "time":
                getattr(full, name)[:, self.everything] += bar
        return LossBar(full, activation=activation_bar)


def _known(arrays: Mapping[str, Array], bars: Mapping[str, Array]) -> dict[str, Array]:
    """Return derivatives by arrays, zero where an array has no value.

    Raises:
        UsageError: a derivative is not finite.
    """
    found = {}
    for name, bar in bars.items():
        found[name] = np.where(np.isnan(arrays[name]), 0.0, bar)
        if not np.isfinite(found[name]).all():
            at = ", ".join(str(int(k)) for k in np.argwhere(~np.isfinite(found[name]))[0])
            raise UsageError(
                f"loss: the derivative by '{name}' is not finite at [{at}]: a root of 0 does this, for example; shift "
                "it by a small number"
            )
    return found


def _named(function: Callable[..., Any], of: Sequence[str] | None) -> tuple[str, ...]:
    """Return the names of the arrays that a function takes.

    Raises:
        UsageError: it is no function, or does not take so many arguments.
    """
    if not callable(function):
        raise UsageError(f"loss: {shown(function)} is no function")
    if of is None:
        return tuple(_arguments(function))
    names = (of,) if isinstance(of, str) else tuple(of)
    try:
        inspect.signature(function).bind(*names)
    except ValueError:
        return names  # it does not say what it takes
    except TypeError as error:
        raise UsageError(f"loss: the function does not take {len(names)} arrays: {error}") from None
    return names


def _arguments(function: Callable[..., Any]) -> list[str]:
    """Return the names of a function's arguments; raise UsageError if it does not name them."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        parameters = []  # type: ignore[assignment]
    by_place = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    named = [p.name for p in parameters if p.kind in by_place and p.default is inspect.Parameter.empty]
    if not named:
        raise UsageError(f"loss: {shown(function)} does not name its arguments: give their names, `of=[...]`")
    return named
