"""The options that several commands share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import typer

Scene = Annotated[Path, typer.Argument(help="Scene file (YAML).", show_default=False)]
Run = Annotated[Path, typer.Argument(help="Run directory, as printed by the run.", show_default=False)]
Overrides = Annotated[
    list[str] | None,
    typer.Option("-o", "--override", metavar="KEY=VALUE", help="Replace a value of the scene (repeatable)."),
]
Out = Annotated[
    Path | None,
    typer.Option("--out", metavar="DIR", help="Folder for run directories; `results` beside the scene if not given."),
]
Fresh = Annotated[bool, typer.Option("--fresh", help="Start over even if this run exists.")]
Threads = Annotated[
    int | None,
    typer.Option(
        "--threads",
        min=1,
        metavar="N",
        help="Largest number of threads; if not given, NUMBA_NUM_THREADS of the environment, or all cores.",
    ),
]
AllowPlugins = Annotated[
    bool,
    typer.Option("--allow-plugins", help="Run the Python plug-in files that the scene names; read them first."),
]
PluginFiles = Annotated[
    list[Path] | None,
    typer.Option("--plugin", metavar="FILE", help="File with your own plug-ins; it is run (repeatable)."),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Show results and warnings, but no progress.")]
Seeds = Annotated[
    int | None, typer.Option("--seeds", metavar="N", help="Learn with N seeds at once, each in a separate run.")
]
Resolution = Annotated[
    str | None,
    typer.Option(
        "--resolution",
        metavar="[DX,DX[,DX]]",
        help="Run on two or three grids, finest last [m], and extrapolate the results to a cell size of zero, with an "
        "error. Without numbers: the scene's grid, and one with cells 1.5 times smaller.",
    ),
]
Jobs = Annotated[
    int | None, typer.Option("--jobs", metavar="N", help="Number of runs at once; the number of threads if not given.")
]
On = Annotated[
    str,
    typer.Option(
        "--on",
        metavar="PLACE",
        help="Where several runs are made: processes of this machine; dask, a local cluster; dask://HOST:PORT; or "
        "slurm.",
    ),
]


def with_grids(words: Sequence[str]) -> Iterator[str]:
    """Yield the words of a command line, with `auto` for an option `--resolution` that no number follows."""
    for word, after in zip(words, [*words, ""][1:], strict=True):
        yield "--resolution=auto" if word == "--resolution" and not after[:1].isdigit() and after[:1] != "." else word
