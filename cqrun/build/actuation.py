"""What drives a scene's actuators and forces: their parts, limits and strengths, and open-loop signals.

Every part of an actuator has one activation a control step. Open-loop signals are knots: held ones each last an equal
part of the run, or of the time that they are spread `over`; linear ones stand at equal distances from its beginning to
its end, and a control step takes the value at its middle. What they ask for is held to each actuator's limits and rate.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cqrun.actuators.actuator import held_to
from cqrun.plugin.choice import Chosen
from cqrun.plugin.contract import Array, Plugin
from cqrun.engine.model import ActuatorModel
from cqrun.errors import Problem, SceneError
from cqrun.build.particles import Particles
from cqrun.scene.activation import Activation
from cqrun.scene.schema import Scene

Values = Mapping[str, Array]


@dataclass(frozen=True)
class Part:
    """A part of an actuator, or of a force without an activation: `path` is that of the whole, without a field."""

    name: str
    actuator: str
    path: str
    spec: Any
    model: ActuatorModel


class Actuation:
    """All parts of all actuators and forces of a scene, in order.

    Args:
        scene: its actuators and forces, and open-loop signals.
        particles: its particles.

    Attributes:
        parts: of actuators, each with an activation.
        passive: of forces without an activation; they come after `parts` where each part has a number.

    Raises:
        SceneError: a part holds no particle, or its particles cannot be what it needs.
    """

    def __init__(self, scene: Scene, particles: Particles) -> None:
        self.scene, self.particles = scene, particles
        self.parts = tuple(self._parts("actuators", scene.actuators))
        self.passive = tuple(self._parts("forces", scene.forces))
        limits = np.array([part.spec.limits for part in self.parts]).reshape(-1, 2)
        self.low, self.high = limits[:, 0], limits[:, 1]
        # what does nothing, or as little as it may
        self.neutral = np.clip([part.spec.neutral for part in self.parts], self.low, self.high)
        step = scene.time.control_step
        self.change = np.array([np.inf if p.spec.rate is None else p.spec.rate * step for p in self.parts])

    def _parts(self, section: str, chosen_by_name: Mapping[str, Chosen[Plugin]]) -> Iterator[Part]:
        x, scene = self.particles.x, self.scene
        for name, chosen in chosen_by_name.items():
            spec: Any = chosen.value
            path = f"{section}.{name}.{chosen.name}"
            for part in spec.parts():
                held = spec.particles(part, x, self.particles.inside)
                problem = spec.problem(x[held], scene.world.dx) if len(held) else None
                if problem or not len(held):
                    raise SceneError([Problem(scene.where(path), path, problem or "holds no particle")])
                full = f"{name}.{part}" if part else name
                model = ActuatorModel(full, spec.kernel, held, spec.constants(x[held]))
                yield Part(full, name, path, spec, model)

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

    # --- lengths at rest ------------------------------------------------------------------------------------------

    def rests(self, x: Array) -> Array:
        """Return the length at rest of `every` part [m] where particles rest at x (N, D)."""
        return np.array([part.spec.rest_length(x[part.model.particles]) for part in self.every])

    def rests_vjp(self, x: Array, rest_bar: Array) -> Array:
        """Return the cotangent of x (N, D)."""
        x_bar = np.zeros(x.shape)
        for part, bar in zip(self.every, rest_bar, strict=True):
            held = part.model.particles
            np.add.at(x_bar, held, part.spec.rest_length_vjp(x[held], float(bar)))
        return x_bar

    # --- weights --------------------------------------------------------------------------------------------------

    def weights(self, values: Values) -> Array:
        """Return the weight of every particle of each part, one part after another; none where all are 1."""
        if not any(self._weight(p) in values or getattr(p.spec, "weight", 1.0) != 1.0 for p in self.parts):
            return np.zeros(0)
        return np.concatenate([self._weights_of(part, values) for part in self.parts])

    def _weights_of(self, part: Part, values: Values) -> Array:
        held, own = part.model.particles, float(getattr(part.spec, "weight", 1.0))
        value = np.asarray(values.get(self._weight(part), own), float)
        if value.ndim == 0:
            return np.full(len(held), float(value))
        place = self._entries(part, value.size)
        return np.where(place >= 0, value[place], own)

    def on_particles(self, values: Values) -> Iterator[tuple[Part, Array]]:
        """Yield every part with its strength on each of its particles (n,), in its actuator's own unit."""
        for part, strength in zip(self.parts, self.strengths(values), strict=False):
            yield part, strength * self._weights_of(part, values)

    def weights_vjp(self, weights_bar: Array, out: dict[str, Array]) -> None:
        """Add to the gradients of the weights that are wanted."""
        begin = 0
        for part in self.parts if len(weights_bar) else ():
            count = len(part.model.particles)
            own, begin = weights_bar[begin : begin + count], begin + count
            if self._weight(part) not in out:
                continue
            bar = out[self._weight(part)]
            if np.ndim(bar) == 0:
                out[self._weight(part)] += own.sum()
            else:
                place = self._entries(part, bar.size)
                np.add.at(bar, place[place >= 0], own[place >= 0])

    def _entries(self, part: Part, size: int) -> Array:
        """Return which entry of a weight with one a particle, or one a group, each particle has; -1 for none."""
        body = part.spec.body
        place = part.model.particles - int(self.particles.of(body).start)
        return place if size == len(self.particles.points[body].x) else self.particles.labels(body)[place]

    @staticmethod
    def _weight(part: Part) -> str:
        return f"{part.path}.weight"

    # --- open-loop signals ----------------------------------------------------------------------------------------

    def _wanted(self, sequence: int, values: Values) -> Array:
        """Return what the signals ask for (T, A); a part without one is to do nothing, or as little as it may."""
        steps, spec = self.scene.time.control_steps, self.scene.activation
        wanted = np.tile(self.neutral, (steps, 1))
        if spec is None:
            return wanted
        span = self._span(spec)
        if spec.random is not None:
            r = spec.random
            rng = np.random.default_rng([r.seed, sequence])
            drawn = rng.uniform(r.low, r.high, (r.knots, len(self.parts)))
            return np.asarray(weights(steps, r.knots, spec.interpolate, span) @ drawn)
        for k, part in enumerate(self.parts):
            own = (spec.signals or {}).get(part.actuator)
            if own is not None:
                path = f"activation.signals.{part.actuator}"
                knots = [float(np.asarray(values.get(f"{path}.{j}", a)).reshape(-1)[0]) for j, a in enumerate(own)]
                wanted[:, k] = weights(steps, len(own), spec.interpolate, span) @ np.array(knots)
        return wanted

    def _span(self, spec: Activation) -> float:
        """Return how many control steps the knots are spread over."""
        time = self.scene.time
        return float(time.control_steps) if spec.over is None else spec.over / time.control_step

    def activations(self, sequence: int, values: Values) -> Array:
        """Return every part's activation at every control step (T, A), for one of the scene's random sequences."""
        return self._held(self._wanted(sequence, values))[0]

    def _held(self, wanted: Array) -> tuple[Array, Array, Array]:
        """Return activations and their derivatives by what is wanted, and by those of the step before, each (T, A)."""
        if not np.isfinite(self.change).any():
            return held_to(wanted, self.neutral, self.low, self.high, self.change)
        given, by_wanted, by_previous = (np.zeros_like(wanted) for _ in range(3))
        for t, row in enumerate(wanted):
            previous = given[t - 1] if t else self.neutral
            given[t], by_wanted[t], by_previous[t] = held_to(row, previous, self.low, self.high, self.change)
        return given, by_wanted, by_previous

    def activations_vjp(self, activation_bar: Array, sequence: int, values: Values, out: dict[str, Array]) -> None:
        """Add to the gradients of the knots that are wanted."""
        spec = self.scene.activation
        if spec is None or spec.signals is None:
            return
        _, by_wanted, by_previous = self._held(self._wanted(sequence, values))
        wanted_bar, following = np.zeros_like(activation_bar), np.zeros(len(self.parts))
        steps, span = len(activation_bar), self._span(spec)
        for t in reversed(range(len(activation_bar))):
            total = activation_bar[t] + following
            wanted_bar[t], following = by_wanted[t] * total, by_previous[t] * total
        for k, part in enumerate(self.parts):
            own = spec.signals.get(part.actuator, [])
            matrix = weights(steps, len(own), spec.interpolate, span) if own else np.zeros((steps, 0))
            for j, bar in enumerate(matrix.T @ wanted_bar[:, k]):
                path = f"activation.signals.{part.actuator}.{j}"
                if path in out:
                    out[path] += bar

    # --- bounds on the substep ------------------------------------------------------------------------------------

    def greatest(self, values: Values) -> Array:
        """Return the greatest activation of each part (A,), without its sign: of its signals, or within its limits."""
        spec = self.scene.activation
        if spec is None:
            return np.maximum(np.abs(self.low), np.abs(self.high))
        count = spec.random.sequences if spec.random is not None else 1
        return np.abs(np.concatenate([self.activations(s, values) for s in range(count)])).max(axis=0, initial=0.0)

    def greatest_stress(self, values: Values) -> Array:
        """Return the greatest active stress of each particle (N,) [Pa]."""
        out = np.zeros(len(self.particles.x))
        sizes = self.greatest(values) * self.strengths(values)[: len(self.parts)]
        for part, size in zip(self.parts, sizes, strict=True):
            out[part.model.particles] += size * part.spec.wave_modulus() * self._weights_of(part, values)
        return out


def weights(n_controls: int, n_knots: int, interpolate: str, span: float) -> Array:
    """Return the matrix (T, K) from knots, spread over `span` control steps, to activations."""
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
