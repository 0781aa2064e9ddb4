"""Progress on standard error: one live line on a terminal, a plain line now and then elsewhere.

Results go to standard output and never through here. Colours follow NO_COLOR.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

from rich.console import Console
from rich.live import Live
from rich.text import Text

from cqrun.running.reporter import StopFlag

PLAIN_EVERY = 5.0
"""Least time between two plain progress lines [s]: log files stay readable."""


class Progress:
    """A `cqrun.running.reporter.Reporter` for people; use it as a context manager.

    Args:
        total: number of iterations at most, where it is known beforehand.
        quiet: print warnings only.
        stream: where to; standard error if not given.
        plain_every: least time between two plain lines [s].
    """

    def __init__(
        self,
        total: int | None = None,
        quiet: bool = False,
        stream: TextIO | None = None,
        plain_every: float = PLAIN_EVERY,
    ) -> None:
        self.stop = StopFlag(announce=self.warn)
        # no emoji: the place `scene.yaml:100:53` is none
        self._console = Console(file=stream or sys.stderr, highlight=False, soft_wrap=True, emoji=False)
        self._quiet = quiet
        self._plain_every = plain_every
        self._total = total
        self._phase = ""
        self._numbers = ""
        self._unprinted = False
        self._last_print = float("-inf")
        self._began: tuple[int, float] | None = None
        live = self._console.is_terminal and not self._console.is_dumb_terminal and not quiet
        self._live = Live(console=self._console, get_renderable=self._render, transient=True) if live else None

    def __enter__(self) -> Progress:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *exception: object) -> None:
        if self._live is not None:
            self._live.stop()
        self._print_the_last()

    def begin(self, total: int) -> None:
        """Say how many iterations are to come at most."""
        self._total = total

    def phase(self, text: str) -> None:
        """Name what happens now."""
        self._print_the_last()
        self._phase, self._numbers, self._began = text, "", None
        if self._live is None and not self._quiet:
            self._print(text)

    def say(self, text: str) -> None:
        """Print a fact, unless quiet."""
        if not self._quiet:
            self._print_the_last()
            self._print(text)

    def update(
        self, iteration: int, loss: float, best: float, step: float, seconds: float, violation: float | None = None
    ) -> None:
        """Show a finished iteration; arguments as in `Reporter.update`."""
        of, left = "", ""
        if self._total is not None:
            of = f"/{self._total}"
            left = f"  {clock(max(self._total - iteration, 0) * seconds)} left"
        beside = f"best {best:.6g}" if violation is None else f"violation {violation:.3g}"
        self._numbers = (
            f"iteration {iteration}{of}  loss {loss:.6g}  {beside}  step {step:.3g}  {seconds:.3g} s/iteration{left}"
        )
        self._print_now_and_then()

    def advance(self, done: int, total: int, text: str) -> None:
        """Show how far the work is, and the time that is left at the pace so far; arguments as in `Reporter`."""
        now = time.monotonic()
        first, began = self._began = self._began or (done, now)
        left = f"  {clock((total - done) * (now - began) / (done - first))} left" if done > first else ""
        self._numbers = f"{text}{left}"
        self._print_now_and_then()

    def _print_now_and_then(self) -> None:
        if self._live is not None or self._quiet:
            return
        self._unprinted = time.monotonic() - self._last_print < self._plain_every
        if not self._unprinted:
            self._print(self._numbers)
            self._last_print = time.monotonic()

    def _print_the_last(self) -> None:
        """Print the numbers that came too soon after others, so that the last ones are never missing."""
        if self._unprinted:
            self._print(self._numbers)
            self._unprinted = False

    def warn(self, text: str) -> None:
        """Print a warning, also when quiet."""
        self._print(f"warning: {text}", style="yellow")

    def _print(self, text: str, style: str | None = None) -> None:
        self._console.print(text, style=style, markup=False)

    def _render(self) -> Text:
        return Text(
            "  ".join(part for part in (self._phase, self._numbers) if part),
            overflow="ellipsis",
            no_wrap=True,
        )


@contextmanager
def reporting(quiet: bool) -> Iterator[Progress]:
    """Show progress and listen to Ctrl-C and SIGTERM while a job runs.

    Raises:
        Stopped: at the second signal, which aborts the job where it stands.
    """
    with Progress(quiet=quiet) as progress, progress.stop:
        try:
            yield progress
        except KeyboardInterrupt:
            message = "aborted; the same command again continues from the last checkpoint"
            raise progress.stop.stopped(message) from None


def clock(seconds: float) -> str:
    """Write a duration as `42 s`, `3:07` or `1:02:09`."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
