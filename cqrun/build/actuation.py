"""The actuation of a scene: parts of actuators and forces, their limits and strengths, and the open-loop signals.

Every part of an actuator has one activation per control step. An open-loop signal is given by knots, which are spread
over the run or over the time `over`. With `interpolate: hold` each knot lasts for an equal part of that time. With
`interpolate: linear` the knots are at equal distances from its start to its end, and a control step takes the value at
the middle of the step. Then activations are clipped to the limits and the rate of each actuator.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cqrun.actuators.actuator import within_limits
from cqrun.build.hosts import host_of
from cqrun.build.particles import Particles
from cqrun.build.surfaces import skin_of
from cqrun.build.values import Values
from cqrun.engine.model import ActuatorModel, riding_at
from cqrun.errors import Problem, SceneError, UsageError
from cqrun.forces.force import Riding
from cqrun.forces.routed import Routed
from cqrun.plugin.choice import Chosen
from cqrun.plugin.contract import Array, Plugin
from cqrun.scene.activation import Activation
from cqrun.scene.schema import Scene


@dataclass(frozen=True)
class Part:
    """A part of an actuator, or of a force without an activation; `path` is the key path of the whole actuator.

    `exact` says whether it acts on points that ride on particles, and not on the particles themselves.
    """

    name: str
    actuator: str
    path: str
    spec: Any
    model: ActuatorModel
    exact: bool = False


class Actuation:
    """All parts of all actuators and forces of a scene, in order.

    Args:
        scene: its actuators and forces, and open-loop signals.
        particles: its particles.

    Attributes:
        parts: of actuators, each with an activation.
        passive: of forces without an activation; they come after `parts` where each part has a number.

    Raises:
        SceneError: a part holds no particle, or the actuator cannot use its particles.
    """

    def __init__(self, scene: Scene, particles: Particles) -> None:
        self.scene, self.particles = scene, particles
        self.parts = tuple(self._parts("actuators", scene.actuators))
        self.passive = tuple(self._parts("forces", scene.forces))
        limits = np.array([part.spec.limits for part in self.parts]).reshape(-1, 2)
        self.low, self.high = limits[:, 0], limits[:, 1]
        # the activation without effect, or the allowed one nearest to it
        self.neutral = np.clip([part.spec.neutral for part in self.parts], self.low, self.high)
        step = scene.time.control_step
        self.change = np.array([np.inf if p.spec.rate is None else p.spec.rate * step for p in self.parts])

    def _parts(self, section: str, chosen_by_name: Mapping[str, Chosen[Plugin]]) -> Iterator[Part]:
        x, scene = self.particles.x, self.scene
        for name, chosen in chosen_by_name.items():
            spec: Any = chosen.value
            path = f"{section}.{name}.{chosen.name}"
            for part in spec.parts():
                try:
                    riding = self._riding(spec, part)
                    indices = spec.particles(part, x, self.particles.inside) if riding is None else riding.particle
                except UsageError as error:
                    raise SceneError([Problem(scene.where(path), path, str(error))]) from None
                problem = spec.problem(x[indices], scene.world.dx) if len(indices) and riding is None else None
                if problem or not len(indices):
                    raise SceneError([Problem(scene.where(path), path, problem or "holds no particle")])
                full = f"{name}.{part}" if part else name
                model = (
                    ActuatorModel(full, spec.kernel, indices, spec.constants(x[indices])) if riding is None else
                    ActuatorModel(full, spec.kernel, indices, riding.constants, riding.x - riding_at(x, indices))
                )  # fmt: skip
                exact = riding is not None and scene.world.frame == "reference"
                yield Part(full, name, path, spec, model, exact)

    def _riding(self, spec: Any, part: str) -> Riding | None:
        """Return the points that a part acts on; None if it acts on particles."""
        if isinstance(spec, Routed):
            return spec.along(host_of(self.scene, self.particles, spec.body))  # type: ignore[attr-defined]
        found: Riding | None = spec.riding(part, lambda: skin_of(self.scene, self.particles, spec.body))
        return found

    @property
    def every(self) -> tuple[Part, ...]:
        """All parts that have a strength: those of actuators, then those of forces."""
        return (*self.parts, *self.passive)

    # --- strengths ----------------------------------------------------------------------------------------------

    def strengths(self, values: Values) -> Array:
        """Return the strength of `every` part, in its own unit."""
        return np.array([float(values.get(self._scale(p), getattr(p.spec, p.spec.scale))) for p in self.every])

    def strengths_vjp(self, strength_bar: Array, out: dict[str, Array]) -> None:
        """Add to the gradients of the strengths that are wanted."""
        for part, bar in zip(self.every, strength_bar, strict=True):
            if self._scale(part) in out:
                out[self._scale(part)] += bar

    @staticmethod
    def _scale(part: Part) -> str:
        return f"{part.path}.{part.spec.scale}"

    def frictions(self, values: Values) -> Array:
        """Return the coefficient of friction of `every` part; 0 for one that has none."""
        return np.array([float(values.get(f"{p.path}.friction", _friction(p.spec))) for p in self.every])

    def frictions_vjp(self, friction_bar: Array, out: dict[str, Array]) -> None:
        """Add to the gradients of the coefficients that are wanted."""
        for part, bar in zip(self.every, friction_bar, strict=True):
            if f"{part.path}.friction" in out:
                out[f"{part.path}.friction"] += bar

    # --- lengths at rest ------------------------------------------------------------------------------------------

    def rest_lengths(self, x: Array) -> Array:
        """Return the length at rest of `every` part [m] where particles rest at x (N, D)."""
        return np.array([part.spec.rest_size(part.model.at_rest(x), part.model.constants) for part in self.every])

    def rest_lengths_vjp(self, x: Array, rest_bar: Array) -> Array:
        """Return the cotangent of x (N, D)."""
        x_bar = np.zeros(x.shape)
        for part, bar in zip(self.every, rest_bar, strict=True):
            found = part.spec.rest_size_vjp(part.model.at_rest(x), part.model.constants, float(bar))
            rides = part.model.particles >= 0
            np.add.at(x_bar, part.model.particles[rides], found[rides])
        return x_bar

    # --- weights --------------------------------------------------------------------------------------------------

    def weights(self, values: Values) -> Array:
        """Return the weights of the particles of all parts, one part after another; empty if all weights are 1."""
        if not any(self._weight(p) in values or getattr(p.spec, "weight", 1.0) != 1.0 for p in self.parts):
            return np.zeros(0)
        return np.concatenate([self._weights_of(part, values) for part in self.parts])

    def _weights_of(self, part: Part, values: Values) -> Array:
        count, default = len(part.model.particles), float(getattr(part.spec, "weight", 1.0))
        value = np.asarray(values.get(self._weight(part), default), float)
        if value.ndim == 0:
            return np.full(count, float(value))
        entry = self._entries(part, value.size)
        return np.where(entry >= 0, value[entry], default)

    def on_particles(self, values: Values) -> Iterator[tuple[Part, Array]]:
        """Yield every part with its strength on each of its particles (n,), in its actuator's own unit."""
        for part, strength in zip(self.parts, self.strengths(values), strict=False):
            yield part, strength * self._weights_of(part, values)

    def weights_vjp(self, weights_bar: Array, out: dict[str, Array]) -> None:
        """Add the cotangents of the weights to the gradients in `out`."""
        begin = 0
        for part in self.parts if len(weights_bar) else ():
            count = len(part.model.particles)
            part_bar, begin = weights_bar[begin : begin + count], begin + count
            if self._weight(part) not in out:
                continue
            bar = out[self._weight(part)]
            if np.ndim(bar) == 0:
                out[self._weight(part)] += part_bar.sum()
            else:
                entry = self._entries(part, bar.size)
                np.add.at(bar, entry[entry >= 0], part_bar[entry >= 0])

    def _entries(self, part: Part, size: int) -> Array:
        """Return the entry of a weight, given per particle or per group, for each particle; -1 for none."""
        body = part.spec.body
        place = part.model.particles - int(self.particles.of(body).start)
        return place if size == len(self.particles.points[body].x) else self.particles.labels(body)[place]

    @staticmethod
    def _weight(part: Part) -> str:
        return f"{part.path}.weight"

    # --- open-loop signals ----------------------------------------------------------------------------------------

    def _requested(self, sequence: int, values: Values) -> Array:
        """Return the activations (T, A) that the signals request; a part without a signal gets its neutral value."""
        steps, spec = self.scene.time.control_steps, self.scene.activation
        requested = np.tile(self.neutral, (steps, 1))
        if spec is None:
            return requested
        span = self._span(spec)
        if spec.random is not None:
            r = spec.random
            rng = np.random.default_rng([r.seed, sequence])
            drawn = rng.uniform(r.low, r.high, (r.knots, len(self.parts)))
            return np.asarray(weights(steps, r.knots, spec.interpolate, span) @ drawn)
        for k, part in enumerate(self.parts):
            signal = (spec.signals or {}).get(part.actuator)
            if signal is not None:
                path = f"activation.signals.{part.actuator}"
                knots = [float(np.asarray(values.get(f"{path}.{j}", a)).reshape(-1)[0]) for j, a in enumerate(signal)]
                requested[:, k] = weights(steps, len(signal), spec.interpolate, span) @ np.array(knots)
        return requested

    def _span(self, spec: Activation) -> float:
        """Return the number of control steps over which the knots are spread."""
        time = self.scene.time
        return float(time.control_steps) if spec.over is None else spec.over / time.control_step

    def activations(self, sequence: int, values: Values) -> Array:
        """Return the activation of every part at every control step (T, A), for one of the random sequences."""
        return self._limited(self._requested(sequence, values))[0]

    def _limited(self, requested: Array) -> tuple[Array, Array, Array]:
        """Return activations within limits and rates, and their derivatives, each (T, A).

        The derivatives are those by the requested activations and by the activations of the step before.
        """
        if not np.isfinite(self.change).any():
            return within_limits(requested, self.neutral, self.low, self.high, self.change)
        limited, by_requested, by_previous = (np.zeros_like(requested) for _ in range(3))
        for t, row in enumerate(requested):
            previous = limited[t - 1] if t else self.neutral
            limited[t], by_requested[t], by_previous[t] = within_limits(row, previous, self.low, self.high, self.change)
        return limited, by_requested, by_previous

    def activations_vjp(self, activation_bar: Array, sequence: int, values: Values, out: dict[str, Array]) -> None:
        """Add the cotangents of the knots to the gradients in `out`."""
        spec = self.scene.activation
        if spec is None or spec.signals is None:
            return
        _, by_requested, by_previous = self._limited(self._requested(sequence, values))
        requested_bar, following = np.zeros_like(activation_bar), np.zeros(len(self.parts))
        steps, span = len(activation_bar), self._span(spec)
        for t in reversed(range(len(activation_bar))):
            total = activation_bar[t] + following
            requested_bar[t], following = by_requested[t] * total, by_previous[t] * total
        for k, part in enumerate(self.parts):
            signal = spec.signals.get(part.actuator, [])
            matrix = weights(steps, len(signal), spec.interpolate, span) if signal else np.zeros((steps, 0))
            for j, bar in enumerate(matrix.T @ requested_bar[:, k]):
                path = f"activation.signals.{part.actuator}.{j}"
                if path in out:
                    out[path] += bar

    # --- bounds on the substep ------------------------------------------------------------------------------------

    def largest_activation(self, values: Values) -> Array:
        """Return the largest |activation| of each part (A,), in its signals or else within its limits."""
        spec = self.scene.activation
        if spec is None:
            return np.maximum(np.abs(self.low), np.abs(self.high))
        count = spec.random.sequences if spec.random is not None else 1
        return np.abs(np.concatenate([self.activations(s, values) for s in range(count)])).max(axis=0, initial=0.0)

    def largest_stress(self, values: Values) -> Array:
        """Return the largest active stress of each particle (N,) [Pa]."""
        out = np.zeros(len(self.particles.x))
        sizes = self.largest_activation(values) * self.strengths(values)[: len(self.parts)]
        for part, size in zip(self.parts, sizes, strict=True):
            out[part.model.particles] += size * part.spec.wave_modulus() * self._weights_of(part, values)
        return out


def _friction(spec: Any) -> float:
    """Return the coefficient of friction in a scene; 0 if there is none."""
    return getattr(spec, "friction", None) or 0.0


def weights(n_controls: int, n_knots: int, interpolate: str, span: float) -> Array:
    """Return the matrix (T, K) that maps knots, spread over `span` control steps, to activations."""
    matrix = np.zeros((n_controls, n_knots))
    middle = np.minimum((np.arange(n_controls) + 0.5) / span, 1.0)
    if interpolate == "hold" or n_knots == 1:
        matrix[np.arange(n_controls), np.minimum((middle * n_knots).astype(int), n_knots - 1)] = 1.0
        return matrix
    at = middle * (n_knots - 1)
    left = np.minimum(at.astype(int), n_knots - 2)
    matrix[np.arange(n_controls), left] = 1.0 - (at - left)
    matrix[np.arange(n_controls), left + 1] = at - left
    return matrix
