"""Colours of particles, by a quantity from the trajectory, or computed from the trajectory and the scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cqrun.build.actuation import Actuation
from cqrun.build.assembly import Assembly
from cqrun.build.particles import Particles, sample
from cqrun.errors import UsageError
from cqrun.figures.quantities import length_unit, shown_unit
from cqrun.figures.run_data import RunData
from cqrun.figures.strain import Strain, green_norm
from cqrun.figures.style import AMOUNT_MAP, PASSIVE, SIGNED_MAP
from cqrun.learning.agent import FILE
from cqrun.learning.replay import IDENTIFIED, kept_of_identified, kept_values
from cqrun.plugin.contract import Array
from cqrun.running.unknowns import values_found
from cqrun.store.frames import Frames
from cqrun.store.result import values_in

if TYPE_CHECKING:
    from matplotlib.cm import ScalarMappable

MATERIAL = {
    "stiffness": ("youngs_modulus", "Young's modulus", "Pa"),
    "density": ("density", "density", "kg/m^3"),
    "poissons_ratio": ("poissons_ratio", "Poisson's ratio", ""),
    "weight": ("weight", "share of the actuator's strength", ""),
}
"""Quantities of the material and of actuators: last name of the key path, label, and unit."""

MOST_RANGED = 48
"""Frames from which the colour range is taken, at most, evenly spread over the run."""

SHARE = 0.995
"""Share of a frame's particles within the colour range, so that one fast particle does not make all others dark."""


@dataclass(frozen=True)
class Colours:
    """The colours of particles in every frame.

    Attributes:
        label: the quantity with its unit, for the colour bar.
        low, high: ends of the colour range, in that unit.
        cmap: name of the colour map.
        values: maps a frame to the values of the particles (N,) in that unit; NaN for particles without a value.
        beyond: whether some values are larger than `high`.
    """

    label: str
    low: float
    high: float
    cmap: str
    values: Callable[[int], Array]
    beyond: bool = False

    def rgb(self, frame: int, paleness: float = 0.0) -> Array:
        """Return the colours of a frame (N, 3) in 0 to 1, mixed with white by `paleness`."""
        return paleness + (1.0 - paleness) * self.shade(self.values(frame))

    def shade(self, values: Array) -> Array:
        """Return the colours (N, 3) in 0 to 1 of values (N,)."""
        import matplotlib
        from matplotlib.colors import to_rgb

        known = np.isfinite(values)
        span = (self.high - self.low) or 1.0
        level = np.clip((np.where(known, values, self.low) - self.low) / span, 0.0, 1.0)
        colours = matplotlib.colormaps[self.cmap](level)[:, :3]
        colours[~known] = to_rgb(PASSIVE)
        return np.asarray(colours)

    def scale(self) -> ScalarMappable:
        """Return the colour map with its range, for a colour bar."""
        import matplotlib
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize

        return ScalarMappable(Normalize(self.low, self.high), matplotlib.colormaps[self.cmap])

    @property
    def extend(self) -> str:
        """Which end of a colour bar has an arrow, because some values are beyond it."""
        return "max" if self.beyond else "neither"


def colours(quantity: str | None, run: RunData, frames: Frames) -> tuple[str, Colours]:
    """Return the quantity (one of `choices.Quantity`) and the colours that show it.

    The colour range is that of the whole run. So a body has the same colours in all pictures of a run.

    Args:
        quantity: the quantity; None means activation if actuators have signals, and displacement otherwise.
        run: the run.
        frames: its trajectory.

    Raises:
        UsageError: the quantity is neither stored nor given by the scene.
    """
    if quantity is None:
        quantity = "activation" if _has_activation(run, frames) else "displacement"
    if quantity in MATERIAL:
        return quantity, _of_material(quantity, run, frames)
    shown = np.unique(np.linspace(0, len(frames) - 1, MOST_RANGED).round().astype(int)).tolist()
    makers = {"activation": _activation, "strain": _strain, "velocity": _velocity}
    return quantity, makers.get(quantity, _displacement)(run, frames, shown)


def _amount(label: str, values: Callable[[int], Array], shown: Sequence[int]) -> Colours:
    """Return colours from zero to a value that nearly all particles stay below in the frames shown."""
    high, most = 0.0, 0.0
    for frame in shown:
        known = (all_values := values(frame))[np.isfinite(all_values)]
        if known.size:
            high, most = max(high, float(np.quantile(known, SHARE))), max(most, float(known.max()))
    return Colours(label, 0.0, high or 1.0, AMOUNT_MAP, values, beyond=most > 1.02 * high)


def _displacement(run: RunData, frames: Frames, shown: Sequence[int]) -> Colours:
    rest = frames.read("x", 0)
    unit = length_unit(max(float(np.ptp(frames.read("x", frame), axis=0).max()) for frame in shown))
    return _amount(unit.label("displacement"), lambda k: unit.factor * _length(frames.read("x", k) - rest), shown)


def _velocity(run: RunData, frames: Frames, shown: Sequence[int]) -> Colours:
    if "v" not in frames.fields:
        raise _absent("velocity", frames, "field v")
    return _amount("speed (m/s)", lambda k: _length(frames.read("v", k).astype(float)), shown)


def _strain(run: RunData, frames: Frames, shown: Sequence[int]) -> Colours:
    if "F" in frames.fields:
        return _amount("strain |E| (Green)", lambda k: green_norm(frames.read("F", k).astype(float)), shown)
    strain = Strain(frames.read("x", 0), frames.bodies)
    return _amount("strain |E| (Green)", lambda k: green_norm(strain.gradient(frames.read("x", k))), shown)


def _length(vectors: Array) -> Array:
    return np.asarray(np.sqrt(np.sum(vectors**2, axis=1)))


# --- of the scene -------------------------------------------------------------------------------------------


def sampled(run: RunData, frames: Frames) -> Particles:
    """Return the scene's particles, and check that the trajectory has the same particles.

    Raises:
        UsageError: the trajectory has other particles, so the scene cannot describe them.
    """
    particles = sample(run.scene)
    bodies = {name: particles.of(name) for name in particles.names}
    if bodies != frames.bodies:
        raise UsageError(
            f"{frames.path}: its particles are not those of {run.path / 'scene.yaml'}; run the scene again with --fresh"
        )
    return particles


def _of_material(quantity: str, run: RunData, frames: Frames) -> Colours:
    values = material_of(run, sampled(run, frames), quantity)
    label, unit_name = MATERIAL[quantity][1:]
    unit = shown_unit(unit_name, float(values.max()))
    shown = unit.factor * values
    low, high = float(shown.min()), float(shown.max())
    if high - low <= 1e-6 * high:
        low, high = 0.0, 2.0 * high or 1.0
    return Colours(unit.label(label), low, high, AMOUNT_MAP, lambda _: shown)


def material_of(run: RunData, particles: Particles, quantity: str) -> Array:
    """Return one of the quantities in MATERIAL for every particle (N,), with the values that the run has found.

    Raises:
        UsageError: the material of a body does not have this quantity.
    """
    assembly, values = Assembly(run.scene, particles), _run_values(run, particles)
    if quantity == "weight":
        return _weight(assembly.actuation, values, len(particles.x))
    result, key = np.zeros(len(particles.x)), MATERIAL[quantity][0]
    for body in particles.names:
        material = assembly.material(body, values)
        path = next((path for path in material if path.endswith(f".{key}")), None)
        if path is None:
            law = run.scene.bodies[body].material.elastic.name
            raise UsageError(f"--color {quantity}: the law {law} of body '{body}' has no {key} to show")
        result[particles.of(body)] = material[path]
    return result


def _run_values(run: RunData, particles: Particles) -> dict[str, Array]:
    """Return the values by path that a run has found, or that a replay used."""
    if run.job == "simulate" and run.has(FILE):
        return kept_values(run.path / FILE)
    if run.job == "simulate" and run.has(IDENTIFIED):
        return kept_of_identified(run.path / IDENTIFIED, run.scene, particles)
    return values_found(run.scene, particles, values_in(run.result))


def _weight(actuation: Actuation, values: Mapping[str, Array], n: int) -> Array:
    """Return the largest weight of any actuator at every particle (N,), 0 without an actuator."""
    weights, largest, begin = actuation.weights(values), np.zeros(n), 0
    for part in actuation.parts:
        indices = part.model.particles
        part_weights = weights[begin : begin + len(indices)] if len(weights) else np.ones(len(indices))
        begin += len(indices)
        if hasattr(part.spec, "weight"):
            largest[indices] = np.maximum(largest[indices], part_weights)
    if not any(hasattr(part.spec, "weight") for part in actuation.parts):
        raise UsageError("--color weight: only muscles and chambers have weights, and the scene of this run has none")
    return largest


def _has_activation(run: RunData, frames: Frames) -> bool:
    """Return whether the activation of every frame is known; frames of equilibria have no control steps."""
    in_time = run.scene.activation is not None and int(frames.step[-1]) <= run.scene.time.control_steps
    return bool(run.scene.actuators) and ("activation" in frames.fields or in_time)


def _activation(run: RunData, frames: Frames, shown: Sequence[int]) -> Colours:
    if not run.scene.actuators:
        raise UsageError("--color activation: the scene of this run has no actuators")
    if "activation" in frames.fields:
        return _signed("activation", lambda k: frames.read("activation", k).astype(float), shown)
    if run.scene.activation is None:
        raise _absent("activation", frames, "field activation, and its scene no `activation` to compute it from")
    actuation = Assembly(run.scene, sampled(run, frames)).actuation
    levels = actuation.activations(0, {})  # a trajectory uses the first of several random sequences
    driven = [part.model.particles for part in actuation.parts]

    def values(frame: int) -> Array:
        level = levels[max(int(frames.step[frame]) - 1, 0)]  # the activation before this frame
        out = np.full(max(part.stop for part in frames.bodies.values()), np.nan)
        for particles, activation in zip(driven, level, strict=True):
            before = out[particles]
            stronger = np.isnan(before) | (abs(activation) > np.abs(np.nan_to_num(before)))
            out[particles] = np.where(stronger, activation, before)
        return out

    return _signed("activation", values, shown)


def _signed(label: str, values: Callable[[int], Array], shown: Sequence[int]) -> Colours:
    """Return colours with a range that is symmetric about zero."""
    most = 0.0
    for frame in shown:
        known = (all_values := values(frame))[np.isfinite(all_values)]
        most = max(most, float(np.abs(known).max()) if known.size else 0.0)
    return Colours(label, -(most or 1.0), most or 1.0, SIGNED_MAP, values)


def _absent(quantity: str, frames: Frames, what: str) -> UsageError:
    others = " and ".join(name for name in ("displacement", "strain") if name != quantity)
    return UsageError(f"--color {quantity}: {frames.path} has no {what}; {others} can be shown for every run")
