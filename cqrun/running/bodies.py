"""Report the bodies of a run: particles, particles per cell, mass, place in the world, and how fine the grid is."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from cqrun.actuators.chamber import is_chamber
from cqrun.build.actuation import Part
from cqrun.build.check_routes import tied
from cqrun.build.limits import rounded_away
from cqrun.build.model import Built
from cqrun.build.thickness import thinnest_parts
from cqrun.engine.model import Inputs
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import body_of
from cqrun.running.reporter import Reporter
from cqrun.running.tables import number
from cqrun.store.run import RunDirectory
from cqrun.store.thinnest import Thinnest


def report_bodies(built: Built, run: RunDirectory, talk: Reporter, inputs: Inputs | None = None) -> None:
    """Report two lines per body and write them into the run's log, with the scene's own inputs if not given."""
    thinnest = thinnest_parts(built)
    size = " x ".join(number(edge) for edge in built.scene.world.size)
    for name in built.particles.names:
        text = f"{name}: {made_of(built, name, inputs)}; {lies(built, name, inputs)} of {size} m"
        for sentence in (text, f"{name}: {resolved(thinnest[name])}"):
            talk.say(sentence)
            run.log(sentence)
    for part in built.assembly.actuation.every:
        if tied(built.particles, part) is not None:
            sentence = f"{part.model.name}: tied to {on_particles(built, part)}"
            talk.say(sentence)
            run.log(sentence)
    if rounding := rounding_of(built):
        talk.say(rounding)
        run.log(rounding)


def rounding_of(built: Built) -> str:
    """Return what the precision of the engine leaves of slow motion; nothing to say of float64."""
    if built.model.real is not np.float32:
        return ""
    least = number(rounded_away(built.model.size, built.model.dt))
    return f"float32 loses motion slower than about {least} m/s: less than a position's last bit"


def on_particles(built: Built, part: Part) -> str:
    """Return what an actuator or a force acts on, and how far the points of its route are from there, as text."""
    if is_chamber(part.spec):
        volume = part.spec.rest_size(part.model.at_rest(built.particles.x), part.model.constants)
        facets = len(part.spec.facets(part.model.constants))
        return f"{number(volume)} m^{built.model.dim} of '{part.spec.body}', in walls of {facets:,} facets"
    count, far = len(part.model.carriers), tied(built.particles, part)
    what = "point" if part.exact else "particle"
    text = f"{count:,} {what}{'s' * (count != 1)} of '{body_of(part.spec)}'"
    if fixed := len(part.model.particles) - count:
        text += f" and {fixed} in the world"
    return text if far is None else f"{text}, at most {far} from the points of its route"


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


def resolved(part: Thinnest) -> str:
    """Return the cells and the particles across the thinnest part of a body as text."""
    cells, particles = f"{part.cells:.2g}", f"{part.particles:.2g}"
    counts = f"{cells} cell{'s' * (cells != '1')} and {particles} particle{'s' * (particles != '1')}"
    return f"{counts} across its thinnest part, {number(part.thickness)} m"


def resolved_lines(thinnest: Mapping[str, Thinnest]) -> Iterator[str]:
    """Yield a line per body about the grid in its thinnest part, for the report of a run."""
    yield from (f"{name}: {resolved(part)}" for name, part in thinnest.items())


def point(x: Array | Sequence[float]) -> str:
    """Return a position as text."""
    return "(" + ", ".join(number(float(c)) for c in x) + ")"
