"""Report the bodies before a run: particles, particles per cell, mass, and place in the world."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cqrun.build.limits import rounded_away
from cqrun.build.model import Built
from cqrun.engine.model import Inputs
from cqrun.plugin.contract import Array
from cqrun.running.reporter import Reporter
from cqrun.running.tables import number
from cqrun.store.run import RunDirectory


def report_bodies(built: Built, run: RunDirectory, talk: Reporter, inputs: Inputs | None = None) -> None:
    """Report one line per body and write it into the run's log, with the scene's own inputs if not given."""
    size = " x ".join(number(edge) for edge in built.scene.world.size)
    for name in built.particles.names:
        text = f"{name}: {made_of(built, name, inputs)}; {lies(built, name, inputs)} of {size} m"
        talk.say(text)
        run.log(text)
    if rounding := rounding_of(built):
        talk.say(rounding)
        run.log(rounding)


def rounding_of(built: Built) -> str:
    """Return what the precision of the engine leaves of slow motion; nothing to say of float64."""
    if built.model.real is not np.float32:
        return ""
    least = number(rounded_away(built.model.size, built.model.dt))
    return f"float32 loses motion slower than about {least} m/s: less than a position's last bit"


def made_of(built: Built, name: str, inputs: Inputs | None = None) -> str:
    """Return a body's number of particles, their density and its mass as text."""
    particles, dx, dim = built.particles, built.scene.world.dx, built.scene.dim
    part, spacing = particles.of(name), particles.spacing[name]
    mass = (inputs or built.assembly.inputs({})).fields.mass[part].sum()
    count, unit = part.stop - part.start, "kg" if dim == 3 else "kg/m"
    in_cell = number((dx / spacing) ** dim)
    return f"{count:,} particles, {in_cell} per cell, {number(spacing)} m apart; mass {number(mass)} {unit}"


def lies(built: Built, name: str, inputs: Inputs | None = None) -> str:
    """Return a body's bounds at rest, and their distance from the nearest face of the world, as text."""
    x = (built.particles.x if inputs is None else inputs.state.x)[built.particles.of(name)]
    low, high = x.min(axis=0), x.max(axis=0)
    room = min(low.min(), (np.array(built.scene.world.size) - high).min())
    return f"from {point(low)} to {point(high)} m, {number(room)} m from the nearest face of the world"


def point(x: Array | Sequence[float]) -> str:
    """Return a position as text."""
    return "(" + ", ".join(number(float(c)) for c in x) + ")"
