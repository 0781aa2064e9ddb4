"""The `cqrun` command: one Typer application with one file per command.

Commands import their dependencies inside their functions, so that help and completion are fast.
Exit codes: 0 done, 1 the run failed, 2 bad scene or usage, 75 stopped but resumable, 130 interrupted.
"""

from __future__ import annotations

import os
import sys
from typing import Annotated, NoReturn

import typer

from cqrun.cli.bench import bench
from cqrun.cli.codesign import codesign
from cqrun.cli.compress import compress
from cqrun.cli.control import control
from cqrun.cli.describe import describe
from cqrun.cli.doctor import doctor
from cqrun.cli.export import export
from cqrun.cli.gradcheck import gradcheck
from cqrun.cli.material import material
from cqrun.cli.new import new
from cqrun.cli.options import with_grids
from cqrun.cli.plot import plot
from cqrun.cli.render import render
from cqrun.cli.report import report
from cqrun.cli.rest import rest
from cqrun.cli.resume import resume
from cqrun.cli.schema import schema
from cqrun.cli.simulate import simulate
from cqrun.cli.sweep import sweep
from cqrun.cli.sysid import sysid
from cqrun.cli.terminal import echo, print_error
from cqrun.cli.validate import validate
from cqrun.cli.warmup import warmup
from cqrun.errors import CqrunError, SceneError, StopNow
from cqrun.running.reporter import StopFlag
from cqrun.version import __version__

COMMANDS = (
    new, sysid, control, codesign, simulate, rest, sweep, gradcheck, resume, validate, describe, schema, plot, render,
    report, export, compress, material, bench, warmup, doctor,
)  # fmt: skip

app = typer.Typer(
    name="cqrun",
    help="Differentiable soft-robot simulation: identify materials, learn motion, check every gradient.",
    epilog="Exit codes: 0 done, 1 failed, 2 bad scene or usage, 75 stopped but resumable, 130 interrupted.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for command in COMMANDS:
    app.command()(command)


def _print_version(wanted: bool) -> None:
    if not wanted:
        return
    from importlib.metadata import version

    others = ", ".join(f"{name} {version(name)}" for name in ("numba", "numpy", "scipy"))
    echo(f"cqrun {__version__} ({others}, Python {sys.version.split()[0]})")
    raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool,
        typer.Option("--version", is_eager=True, callback=_print_version, help="Print versions and exit."),
    ] = False,
) -> None:
    pass


def _with_home(word: str) -> str:
    """Return a word of the command line with a path's `~` replaced; shells leave it in `--out=~/results`."""
    option, equals, value = word.partition("=") if word.startswith("--") else ("", "", word)
    return f"{option}{equals}{os.path.expanduser(value)}"  # noqa: PTH111 that of Path fails where there is no such user


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command line and exit; this is the one place that handles cqrun's errors.

    Args:
        arguments: the arguments without the program's name; those of the process if not given.
    """
    with StopFlag() as stop:
        words = sys.argv[1:] if arguments is None else arguments
        try:
            app([_with_home(word) for word in with_grids(words)], prog_name="cqrun")
        except CqrunError as error:
            # a scene's problems start with file:line:column, which editors follow
            prefix = "" if isinstance(error, SceneError) else "error: "
            print_error(f"{prefix}{error}")
            sys.exit(error.exit_code)
        except StopNow:
            reason = stop.named("stopped before it was finished; give the command again")
            print_error(f"error: {reason}")
            sys.exit(stop.exit_code)
    raise AssertionError("typer ends the process itself")
