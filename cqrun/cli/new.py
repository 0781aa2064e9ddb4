"""`cqrun new`: write a scene or a plug-in to start from."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from cqrun.cli.options import Quiet
from cqrun.cli.terminal import echo
from cqrun.errors import UsageError


class What(StrEnum):
    """What can be written."""

    sysid = "sysid"
    control = "control"
    codesign = "codesign"
    simulate = "simulate"
    rest = "rest"
    material = "material"
    plugin = "plugin"


class Unit(StrEnum):
    """Length units of recordings."""

    m = "m"
    cm = "cm"
    mm = "mm"


def new(
    what: Annotated[What, typer.Argument(help="What to write.", show_default=False)],
    names: Annotated[
        list[str],
        typer.Argument(
            metavar="NAME", help="Scene file, such as beam.yaml; for a plug-in: KIND NAME.", show_default=False
        ),
    ],
    markers: Annotated[
        Path | None,
        typer.Option("--markers", metavar="FILE", help="Recording of markers that the scene of sysid fits."),
    ] = None,
    units: Annotated[
        Unit | None, typer.Option("--units", help="Length unit of the recording, if it names none.")
    ] = None,
    size: Annotated[
        str | None,
        typer.Option("--size", metavar="X,Y[,Z]", help="Edges of the body in m, along the axes of the file."),
    ] = None,
    corner: Annotated[
        str | None,
        typer.Option("--corner", metavar="X,Y[,Z]", help="Its lower corner at rest, as in the file, in m."),
    ] = None,
    clamp: Annotated[
        float | None, typer.Option("--clamp", metavar="LENGTH", help="Length of the body that is held, in m.")
    ] = None,
    density: Annotated[float | None, typer.Option("--density", help="Density of the body in kg/m^3.")] = None,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write to.")] = Path(),
    force: Annotated[bool, typer.Option("--force", help="Overwrite files that are there already.")] = False,
    quiet: Quiet = False,
) -> None:
    """Write a small scene, or a plug-in with a scene that uses it; each runs as it is, and says what to change.

    `new sysid NAME --markers FILE` proposes a scene for a recording: body, clamp, times, units and unknowns. It lists
    what is a guess; give what you have measured with --size, --corner, --clamp and --density. `new material NAME` fits
    a tensile test. `new plugin KIND NAME` writes NAME.py and NAME.yaml.
    """
    edges, lowest = _numbers("size", size), _numbers("corner", corner)
    of_sysid = {"units": units, "size": size, "corner": corner, "clamp": clamp, "density": density, "markers": markers}
    _require_fitting(what, names, of_sysid)
    from cqrun.cli.progress import reporting

    with reporting(quiet, f"reading {markers}" if markers else "reading the templates"):
        from cqrun.jobs.new.files import new_fit, new_plugin, new_scene
        from cqrun.jobs.new.lengths import Given

        if what is What.plugin:
            written = new_plugin(names[0], names[1], out, overwrite=force)
        elif what is What.sysid:
            assert markers is not None
            written = new_fit(markers, out / names[0], units, Given(edges, lowest, clamp, density), overwrite=force)
        else:
            written = new_scene(what.value, out / names[0], overwrite=force)
    for line in written.found:
        echo(line)
    for path in written.files:
        echo(f"written: {path}")
    if written.guesses:
        echo("guessed; check these in the scene, in this order:")
    for k, guess in enumerate(written.guesses, 1):
        echo(f"  {k}. {guess}")
    echo(f"next: {written.next}")


def _numbers(option: str, text: str | None) -> list[float] | None:
    """Return the numbers of an option that are separated by commas."""
    try:
        return None if text is None else [float(number) for number in text.split(",")]
    except ValueError:
        message = f"--{option} {text}: takes numbers in m with commas between them, such as 0.12,0.016,0.012"
        raise UsageError(message) from None


def _require_fitting(what: What, names: list[str], of_sysid: Mapping[str, object]) -> None:
    """Raise a UsageError for names, and options of `new sysid` by name, that do not go with what is written."""
    if what is What.plugin and len(names) != 2:
        raise UsageError("a plug-in needs its kind and a name, such as `cqrun new plugin elastic my_law`")
    if what is not What.plugin and len(names) != 1:
        raise UsageError(f"give one name for the scene, such as `cqrun new {what} my_{what}.yaml`")
    if what is What.sysid and of_sysid["markers"] is None:
        raise UsageError(
            "name the recording with --markers FILE (C3D, CSV or trajectory.h5). For a tensile test: "
            "`cqrun new material NAME`; for data of another kind: `cqrun new plugin measurement NAME`"
        )
    strange = [option for option, value in of_sysid.items() if value is not None]
    if what is not What.sysid and strange:
        raise UsageError(f"--{strange[-1]} belongs to `cqrun new sysid`, not to `cqrun new {what}`")
