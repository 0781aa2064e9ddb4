"""Open-loop signals of the actuators: knots in a scene to one level a control step.

Held knots each last an equal part of the run; linear ones stand at equal distances from its beginning to its
end, and a control step takes the value at its middle.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cqrun.contract import Array
from cqrun.scene.schema import Scene


def weights(n_controls: int, n_knots: int, interpolate: str) -> Array:
    """Return the matrix (T, K) from knots to levels."""
    matrix = np.zeros((n_controls, n_knots))
    middle = (np.arange(n_controls) + 0.5) / n_controls
    if interpolate == "hold" or n_knots == 1:
        matrix[np.arange(n_controls), np.minimum((middle * n_knots).astype(int), n_knots - 1)] = 1.0
        return matrix
    at = middle * (n_knots - 1)
    left = np.minimum(at.astype(int), n_knots - 2)
    matrix[np.arange(n_controls), left] = 1.0 - (at - left)
    matrix[np.arange(n_controls), left + 1] = at - left
    return matrix


def signals(scene: Scene, sequence: int, values: Mapping[str, Array]) -> Array:
    """Return every actuator's level at every control step (T, A); 0 for one without a signal."""
    steps, names = scene.time.control_steps, list(scene.actuators)
    levels = np.zeros((steps, len(names)))
    spec = scene.activation
    if spec is None:
        return levels
    if spec.random is not None:
        r = spec.random
        rng = np.random.default_rng([r.seed, sequence])
        knots = rng.uniform(r.low, r.high, (r.knots, len(names)))
        return weights(steps, r.knots, spec.interpolate) @ knots
    for k, name in enumerate(names):
        own = (spec.signals or {}).get(name)
        if own is not None:
            path = f"activation.signals.{name}"
            given = [float(np.asarray(values.get(f"{path}.{j}", knot)).reshape(-1)[0]) for j, knot in enumerate(own)]
            levels[:, k] = weights(steps, len(own), spec.interpolate) @ np.array(given)
    return levels


def signal_weights(scene: Scene, actuator: str, level_bar: Array) -> dict[str, Array]:
    """Return the cotangent of an actuator's knots, by the path of its signal, from that of its levels (T,)."""
    spec = scene.activation
    own = (spec.signals or {}).get(actuator) if spec is not None else None
    if spec is None or own is None:
        return {}
    matrix = weights(scene.time.control_steps, len(own), spec.interpolate)
    return {f"activation.signals.{actuator}": matrix.T @ level_bar}
