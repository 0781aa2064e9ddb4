"""`cqrun new sysid`: the text of a scene that is fitted to a recording of markers."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cqrun.characters import printable
from cqrun.errors import DataError
from cqrun.explain import listed
from cqrun.jobs.new.lengths import PER_CELL, Given
from cqrun.jobs.new.proposal import DENSITY, MILLI, NOTHING, POISSON, Proposal, propose, unit_guess
from cqrun.jobs.new.seen import Seen, look
from cqrun.measurements.recording import Recording
from cqrun.plugin.contract import Array
from cqrun.store.recordings import read_recording

LAW = "bodies.body.material.elastic.fixed_corotated.youngs_modulus"
PLAIN = re.compile(r"(\.\./)*/?[A-Za-z][\w./-]*( [\w./-]+)*")
NOT_TEXT = {"y", "n", "yes", "no", "on", "off", "true", "false", "null"}
"""Words that YAML does not take as text."""

SAY_IT = {".c3d", ".h5"}
"""Endings of files that are in metres if they are read as metres: they say it, or cqrun has made them."""

WIDEST, MOST_LINES = 130, 50
"""Characters in a line, and lines in a scene."""

MARKERS = (12, 8, 6, 4)
"""So many markers are in the scene."""

DENSITY_GUESS = "that of silicone rubber"

FAR = 2
"""A file that lies more folders above the scene is named by its whole path."""


@dataclass(frozen=True)
class FitScene:
    """A scene for a recording: its text, what was found in the file, and what to check, in order."""

    text: str
    found: tuple[str, ...]
    guesses: tuple[str, ...]


def fit_scene(file: Path, scene: Path, units: str | None = None, given: Given = NOTHING) -> FitScene:
    """Return a scene for a recording.

    Args:
        file: the recording, in any format that `read_recording` reads.
        scene: where the scene will be, which names the file from there.
        units: length unit of the file; if absent the one that it states, or else a guess.
        given: what is known of the body.

    Raises:
        DataError: the recording cannot be read, or shows too little. UsageError: what is given does not fit it.
    """
    recording, unit, guessed = _read(file, units)
    for most in MARKERS:  # fewer if their names are long
        seen = look(recording, most, given.fewest)
        proposal = propose(seen, given)
        rubber = f"{DENSITY:g} kg/m^3, {DENSITY_GUESS}, and " if given.density is None else ""
        proposal.guesses["density"] = f"{rubber}a Poisson's ratio of {POISSON}"
        if guessed:
            apart = MILLI * float(np.max(np.ptp(seen.rest, axis=0)))
            proposal.guesses["units"] = (
                f"lengths in the file are in {unit}, so the markers are up to {apart:.3g} mm apart"
            )
        lines = list(_lines(proposal, file, scene, unit if guessed or units else None))
        if len(lines) <= MOST_LINES:
            break
    order = ("units", "gravity", "body", "clamp", "density", "stiffness", "start")
    return FitScene("\n".join(lines) + "\n", tuple(_found(seen, proposal)), tuple(
        proposal.guesses[name] for name in order if name in proposal.guesses
    ))  # fmt: skip


def _read(file: Path, units: str | None) -> tuple[Recording, str, bool]:
    """Return a recording, its unit, and whether that is a guess."""
    if units is not None:
        return read_recording(file, units=units), units, False
    in_metres = None
    try:
        recording = read_recording(file)
    except DataError:
        recording = in_metres = read_recording(file, units="m")  # a file that must name its unit, and does not
    if in_metres is None:
        in_metres = read_recording(file, units="m")
    stated = not np.array_equal(recording.positions, in_metres.positions, equal_nan=True)
    unit = None if stated else unit_guess(recording)
    if unit is not None:
        return read_recording(file, units=unit), unit, True
    return recording, "m", not stated and file.suffix.lower() not in SAY_IT


def _found(seen: Seen, p: Proposal) -> Iterator[str]:
    """Yield what was found in a recording."""
    yield f"{len(seen.names)} marker{'s' * (len(seen.names) != 1)}: {listed(map(printable, seen.names), 8)}"
    if seen.left_out:
        yield f"not used: {listed(seen.left_out, 6)}"
    rests = listed([f"{begin:.4g} to {end:.4g} s" for begin, end in seen.rests], 6)
    yield f"all markers at rest: {rests if seen.rests else 'never'}"
    if seen.period is not None:
        yield f"rhythm of the motion: {1.0 / seen.period:.3g} Hz"
    if p.shift.any():
        yield f"a world begins at 0, so the scene adds {_vector(p.shift, 6)} m to the positions of the file"


# --- text -------------------------------------------------------------------------------------------------------


def _lines(p: Proposal, file: Path, scene: Path, unit: str | None) -> Iterator[str]:
    """Yield the lines of the scene."""
    digits = 4 - int(np.floor(np.log10(p.size.max())))
    yield f"# A fit to the markers in {printable(file.name)}. A line with `guess:` is what the recording suggests:"
    yield "# check it, and put your own numbers there. Lengths are in m, times in s, pressures in Pa."
    yield f"#   cqrun validate {printable(scene.name)}     # checks the scene"
    yield f"#   cqrun sysid {printable(scene.name)}        # finds the unknowns, with intervals"
    yield "#   cqrun describe elastic      # lists the laws"
    yield "cqrun: 1"
    yield f"title: {text_of(f'a fit to {printable(file.name)}')}"
    yield "job: sysid"
    yield f"# guess: {p.guesses['gravity']}"
    yield f"world: {{size: {_vector(p.world, digits)}, dx: {p.dx:g}, gravity: {_vector(p.gravity, 4)}}}"
    yield "bodies:"
    yield "  body:"
    if "body" in p.guesses:
        yield f"    # guess: {p.guesses['body']}"
    yield f"    shape: {{box: {{corner: {_vector(p.corner, digits)}, size: {_vector(p.size, digits)}}}}}"
    yield f"    particles_per_cell: {PER_CELL[len(p.size)]}"
    yield "    material:"
    yield f"      density: {p.density:g}" + (
        "   # guess: silicone rubber" if "silicone" in p.guesses["density"] else ""
    )
    yield f"      # guess: {p.guesses['stiffness']}"
    yield f"      elastic: {{fixed_corotated: {{youngs_modulus: {_number(p.modulus)}, poissons_ratio: {POISSON}}}}}"
    yield "boundaries:"
    if "clamp" in p.guesses:
        yield f"  # guess: {p.guesses['clamp']}"
    corner, size = (_vector(x, digits) for x in p.clamp)
    yield f"  clamp: {{sticky: {{region: {{box: {{corner: {corner}, size: {size}}}}}}}}}"
    yield "loads:"
    yield "  air: {damping: {rate: 1}}   # drag of the air, and all other losses. A material has its own, `viscosity`;"
    yield "  # few recordings tell the two apart, and a viscosity needs shorter substeps."
    yield f"time: {{duration: {p.duration:.6g}, control_step: {p.control_step:g}}}"
    yield from _data(p, file, scene, unit, digits)
    yield from _unknowns(p, _name_of(file))
    yield "optimizer: {least_squares: {max_iterations: 15, function_tolerance: 1.0e-4}}"


def _data(p: Proposal, file: Path, scene: Path, unit: str | None, digits: int) -> Iterator[str]:
    """Yield the section with the recording."""
    yield "data:"
    yield "  recordings:"
    yield f"    {_name_of(file)}:"
    yield f"      file: {text_of(_from_scene(file, scene))}"
    if unit is not None:
        yield f"      units: {unit}" + (f"   # guess: {p.guesses['units']}" if "units" in p.guesses else "")
    yield f"      start: {p.start:.5g}   # guess: {p.guesses['start']}"
    if p.still is not None:
        turned = f", turned by {p.degrees:g} degrees about the vertical" if p.degrees else ""
        yield f"      # while all markers rest, they are where `markers` says, in the axes of the file{turned}"
        yield f"      # and moved by {_vector(p.shift, digits)} m; the fit compares how far they get from there."
        yield f"      still: [{p.still[0]:.5g}, {p.still[1]:.5g}]"
    if p.offset is not None:
        yield f"      offset: {_vector(p.offset, digits)}   # from the axes of the file to those of the scene"
    yield "      markers:   # where each is when the body is at rest; points off the body move with it"
    places = [f"{text_of(name)}: {_vector(x, digits)}" for name, x in zip(p.names, p.places, strict=True)]
    yield from _flow(places, "        ")


def _unknowns(p: Proposal, recording: str) -> Iterator[str]:
    """Yield the section with what is fitted."""
    bounds = {
        LAW: (p.modulus / p.reach, p.modulus * p.reach),
        "loads.air.damping.rate": (0.01, 20.0),
    }
    yield "unknowns:   # what is fitted, between wide bounds: narrow them if you know more"
    for path, (low, high) in bounds.items():
        yield f"  {path}: {{bounds: [{_number(low)}, {_number(high)}], scale: log}}"
    if p.starts is not None:
        yield f"  data.recordings.{recording}.start: {{bounds: [{p.starts[0]:.5g}, {p.starts[1]:.5g}]}}"


def _flow(entries: list[str], indent: str) -> Iterator[str]:
    """Yield a mapping on as many lines as it needs."""
    line = f"{indent}{{{entries[0]}"
    for entry in entries[1:]:
        if len(line) + len(entry) + 3 > WIDEST:
            yield f"{line},"
            line = f"{indent} {entry}"
        else:
            line += f", {entry}"
    yield f"{line}}}"


def text_of(text: str) -> str:
    """Return a text as YAML, in quotes where it needs them."""
    plain = PLAIN.fullmatch(text) and text.isascii() and text.lower() not in NOT_TEXT
    return text if plain else json.dumps(text, ensure_ascii=False)


def _name_of(file: Path) -> str:
    """Return a name for a recording, of letters, digits and _."""
    name = re.sub(r"\W+", "_", file.stem, flags=re.ASCII).strip("_").lower()
    return name if re.match(r"[a-z_]", name) else f"recording_{name}".rstrip("_")


def _from_scene(file: Path, scene: Path) -> str:
    """Return the name of a file from the folder of the scene on, or its whole path if it is far away."""
    near = Path(os.path.relpath(file, scene.parent))
    return str(near if near.parts.count("..") <= FAR else file.resolve())


def _vector(x: Array, digits: int) -> str:
    return f"[{', '.join(f'{round(float(c), digits) + 0.0:g}' for c in x)}]"


def _number(number: float) -> str:
    """Return a number as YAML: `2.4e5` is one only if it has a point."""
    if 1e-3 <= number < 1e4:
        return f"{number:.3g}" if number < 1000 else f"{number:.0f}"
    mantissa, power = f"{number:.1e}".split("e")
    return f"{mantissa}e{int(power)}"
