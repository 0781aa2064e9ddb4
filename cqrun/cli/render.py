"""`cqrun render`: make movies and stills of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from cqrun.cli.options import AllowPlugins, Quiet, Run
from cqrun.cli.terminal import echo
from cqrun.errors import UsageError
from cqrun.figures.choices import Look, Quantity

SUFFIXES = {"gif": ".gif", "mp4": ".mp4", "png": ".png", "stills": ".png", "onion": ".png"}


def render(
    run: Run,
    gif: Annotated[bool, typer.Option("--gif", help="A movie as GIF (the default).")] = False,
    mp4: Annotated[bool, typer.Option("--mp4", help="A movie as MP4 (extra 'video').")] = False,
    png: Annotated[bool, typer.Option("--png", help="The last frame as a picture.")] = False,
    stills: Annotated[
        int | None, typer.Option("--stills", min=1, metavar="N", help="N pictures, spread evenly over the time.")
    ] = None,
    onion: Annotated[
        int | None,
        typer.Option("--onion", min=2, metavar="N", help="N instants in one picture, the earlier ones paler."),
    ] = None,
    color: Annotated[
        Quantity | None,
        typer.Option(
            "--color", help="Quantity that colours the particles; activation if there is any, else displacement."
        ),
    ] = None,
    fps: Annotated[float, typer.Option("--fps", min=1, max=100, help="Pictures per second in a movie.")] = 25.0,
    every: Annotated[int, typer.Option("--every", min=1, metavar="N", help="Only every N-th frame in a movie.")] = 1,
    view: Annotated[Look | None, typer.Option("--view", help="Direction of view in 3D; iso if not given.")] = None,
    trail: Annotated[
        str | None,
        typer.Option(
            "--trail",
            metavar="BODY|GROUP",
            help="Body or group whose centroid leaves a trail; 'none' for no trail. If not given: the groups that have "
            "a goal, or else each body.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="FILE", help="File to write; a file in the run's figures/ if not given."),
    ] = None,
    allow_plugins: AllowPlugins = False,
    quiet: Quiet = False,
) -> None:
    """Draw the motion of a run: a movie, stills, or several instants in one picture.

    The run need not be finished. Scenes in 3D need the extra 'viz3d'.
    """
    options = {"gif": gif, "mp4": mp4, "png": png, "stills": stills is not None, "onion": onion is not None}
    kinds = _kinds([name for name, given in options.items() if given], output)
    from cqrun.cli.progress import working

    with working(quiet, allow_plugins, f"reading {run}") as reporter:
        from cqrun.figures.render import RenderOptions
        from cqrun.figures.render import render as draw

        if "mp4" in kinds:  # before anything else is drawn
            from cqrun.figures.movie import ffmpeg

            ffmpeg()
        for kind in kinds:
            count = (stills if kind == "stills" else onion) or 1
            wanted = RenderOptions(kind, count, color, fps, every, view, trail, output)
            for path in draw(run, wanted, reporter):
                echo(path)


def _kinds(options: list[str], output: Path | None) -> list[Literal["gif", "mp4", "png", "stills", "onion"]]:
    """Return what to draw, from the options or from the suffix of the file.

    Raises:
        UsageError: there are several options for one file, or its suffix does not fit.
    """
    if len(options) > 1 and output is not None:
        several = " and ".join(f"--{option}" for option in options)
        raise UsageError(f"-o {output}: one file cannot be {several}: leave out -o, or give one of them")
    by_suffix = {".gif": "gif", ".mp4": "mp4", ".png": "png"}
    suffix = output.suffix.lower() if output is not None else ""
    kinds = options or [by_suffix.get(suffix, "gif")]
    if output is not None and suffix != SUFFIXES[kinds[0]]:
        raise UsageError(
            f"-o {output}: must end in {SUFFIXES[kinds[0]]}, as --{kinds[0]} makes it; or in .gif, .mp4 or .png"
        )
    return kinds  # type: ignore[return-value]  # literals: keys of SUFFIXES
