"""What commands print: lines in which names and titles of files control nothing, on a terminal that may be closed."""

from __future__ import annotations

import errno
import os
import sys
from contextlib import suppress
from typing import Any, TextIO

import typer

from cqrun.characters import harmless


def echo(text: object, *, err: bool = False) -> None:
    """Print a line on standard output, or on standard error."""
    try:
        typer.echo(harmless(str(text)), err=err)
    except OSError as error:
        leave_closed(sys.stderr if err else sys.stdout, error)


def print_error(text: str) -> None:
    """Print the last words of a command on standard error."""
    stream: Any = Closable(sys.stderr)
    print(harmless(text), file=stream, flush=True)


class Closable:
    """A stream that loses what is written after its terminal was closed, so that the work ends as SIGHUP asks."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write text, and return its length."""
        try:
            return self._stream.write(text)
        except OSError as error:
            leave_closed(self._stream, error)
            return len(text)

    def flush(self) -> None:
        """Write what is still in the buffer."""
        try:
            self._stream.flush()
        except OSError as error:
            leave_closed(self._stream, error)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def leave_closed(stream: TextIO, error: OSError) -> None:
    """Send a stream, with what is in its buffer, nowhere if an error says that its terminal is gone; or raise it."""
    if error.errno != errno.EIO:
        raise error
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)
    with suppress(OSError):
        stream.flush()
