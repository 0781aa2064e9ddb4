"""The options that commands share, spelt once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

DEFAULT_OUT = Path("results")

Scene = Annotated[Path, typer.Argument(help="Scene file (YAML).", show_default=False)]
Run = Annotated[Path, typer.Argument(help="Run directory, as printed by the run.", show_default=False)]
Overrides = Annotated[
    list[str] | None,
    typer.Option("-o", "--override", metavar="KEY=VALUE", help="Replace a value of the scene (repeatable)."),
]
Out = Annotated[Path, typer.Option("--out", metavar="DIR", help="Where run directories are made.")]
Fresh = Annotated[bool, typer.Option("--fresh", help="Start over, even if this run exists.")]
Threads = Annotated[
    int | None, typer.Option("--threads", min=1, metavar="N", help="Threads to use at most; all cores if not given.")
]
AllowPlugins = Annotated[
    bool,
    typer.Option("--allow-plugins", help="Run the Python files that the scene names as its plug-ins: read them first."),
]
PluginFiles = Annotated[
    list[Path] | None,
    typer.Option("--plugin", metavar="FILE", help="A file with plug-ins of your own; it is run (repeatable)."),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress; results and warnings only.")]
Seeds = Annotated[
    int | None, typer.Option("--seeds", metavar="N", help="Learn from N seeds side by side, each a run of its own.")
]
Jobs = Annotated[int | None, typer.Option("--jobs", metavar="N", help="Runs at once; as many as threads if not given.")]
