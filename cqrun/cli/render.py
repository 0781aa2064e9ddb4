"""`cqrun render`: movies and stills of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from cqrun.cli.options import AllowPlugins, Quiet, Run
from cqrun.errors import UsageError
from cqrun.figures.choices import Look, Quantity

SUFFIXES = {"gif": ".gif", "mp4": ".mp4", "png": ".png", "stills": ".png", "onion": ".png"}


def render(
    run: Run,
    gif: Annotated[bool, typer.Option("--gif", help="A movie as GIF; so it is if nothing is said.")] = False,
    mp4: Annotated[bool, typer.Option("--mp4", help="A movie as MP4 (extra 'video').")] = False,
    png: Annotated[bool, typer.Option("--png", help="The last frame as a picture.")] = False,
    stills: Annotated[
        int | None, typer.Option("--stills", min=1, metavar="N", help="N pictures, spread over the time.")
    ] = None,
    onion: Annotated[
        int | None, typer.Option("--onion", min=2, metavar="N", help="N instants in one picture, early ones pale.")
    ] = None,
    color: Annotated[
        Quantity | None,
        typer.Option("--color", help="What colours particles; activation if there is any, else displacement."),
    ] = None,
    fps: Annotated[float, typer.Option("--fps", min=1, max=100, help="Pictures a second of a movie.")] = 25.0,
    every: Annotated[int, typer.Option("--every", min=1, metavar="N", help="Only every N-th frame in a movie.")] = 1,
    view: Annotated[Look | None, typer.Option("--view", help="In 3D, from where; iso if not given.")] = None,
    trail: Annotated[
        str | None,
        typer.Option("--trail", metavar="BODY|GROUP", help="Whose centroid leaves a trail; 'none' for nobody's."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="FILE", help="Where to; into the run's figures/ if not given.")
    ] = None,
    allow_plugins: AllowPlugins = False,
    quiet: Quiet = False,
) -> None:
    """Draw the motion of a run, finished or not: a movie, stills, or several instants in one picture.

    2D needs nothing more; 3D needs the extra 'viz3d'.
    """
    chosen = {"gif": gif, "mp4": mp4, "png": png, "stills": stills is not None, "onion": onion is not None}
    kind = _kind([name for name, wanted in chosen.items() if wanted], output)
    from cqrun.cli.progress import reporting
    from cqrun.figures.render import Wanted
    from cqrun.figures.render import render as draw
    from cqrun.scene.plugin_files import plugins_allowed

    wanted = Wanted(kind, stills or onion or 1, color, fps, every, view, trail, output)
    with plugins_allowed(allow_plugins), reporting(quiet) as reporter:
        paths = draw(run, wanted, reporter)
    for path in paths:
        typer.echo(path)


def _kind(asked: list[str], output: Path | None) -> Literal["gif", "mp4", "png", "stills", "onion"]:
    """Return what to draw: what was asked for, or what the file's name says.

    Raises:
        UsageError: several things were asked for, or the file's name says another.
    """
    if len(asked) > 1:
        raise UsageError(f"--{asked[0]} and --{asked[1]}: give one of --gif, --mp4, --png, --stills N and --onion N")
    by_suffix = {".gif": "gif", ".mp4": "mp4", ".png": "png"}
    suffix = output.suffix.lower() if output is not None else ""
    kind = asked[0] if asked else by_suffix.get(suffix, "gif")
    if output is not None and suffix != SUFFIXES[kind]:
        raise UsageError(f"-o {output}: must end in {SUFFIXES[kind]}, as --{kind} makes it; or in .gif, .mp4 or .png")
    return kind  # type: ignore[return-value]  # a literal: one of the keys of SUFFIXES
