"""What commands print: lines in which names and titles of files control nothing."""

from __future__ import annotations

import typer

from cqrun.characters import harmless


def echo(text: object, *, err: bool = False) -> None:
    """Print a line on standard output, or on standard error."""
    typer.echo(harmless(str(text)), err=err)
