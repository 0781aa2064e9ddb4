"""Show progress on standard error: one live line on a terminal, or else a plain line from time to time.

Results are printed on standard output by other modules. Colours follow NO_COLOR.
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

from cqrun.characters import harmless
from cqrun.running.reporter import StopFlag

PLAIN_EVERY = 5.0
"""Shortest time between two plain progress lines [s], so that log files remain readable."""


class Progress:
    """A `cqrun.running.reporter.Reporter` that prints for people; use it as a context manager.

    Args:
        total: largest number of iterations, if it is known.
        quiet: print only warnings.
        stream: stream to print to; standard error if not given.
        plain_every: shortest time between two plain lines [s].
    """

    def __init__(
        self,
        total: int | None = None,
        quiet: bool = False,
        stream: TextIO | None = None,
        plain_every: float = PLAIN_EVERY,
    ) -> None:
        self.stop = StopFlag(announce=self.warn)
        # no emoji: `:100:` in the place `scene.yaml:100:53` is the name of one
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
        self._print_pending()

    def begin(self, total: int) -> None:
        """Set how many iterations there will be at most."""
        self._total = total

    def phase(self, text: str) -> None:
        """Show what happens now."""
        self._print_pending()
        self._phase, self._numbers, self._began = text, "", None
        if self._live is None and not self._quiet:
            self._print(text)

    def say(self, text: str) -> None:
        """Print a fact, unless quiet."""
        if not self._quiet:
            self._print_pending()
            self._print(text)

    def update(
        self, iteration: int, loss: float, best: float, step: float, seconds: float, violation: float | None = None
    ) -> None:
        """Show a finished iteration; arguments as in `Reporter.update`."""
        of, left = "", ""
        if self._total is not None:
            of = f"/{self._total}"
            left = f"  {clock(max(self._total - iteration, 0) * seconds)} left"
        best_text = f"best {best:.6g}" if violation is None else f"violation {violation:.3g}"
        self._numbers = (
            f"iteration {iteration}{of}  loss {loss:.6g}  {best_text}  step {step:.3g}  {seconds:.3g} s/iteration{left}"
        )
        self._print_if_due()

    def advance(self, done: int, total: int, text: str) -> None:
        """Show the progress of the work and an estimate of the remaining time; arguments as in `Reporter`."""
        now = time.monotonic()
        first, began = self._began = self._began or (done, now)
        left = f"  {clock((total - done) * (now - began) / (done - first))} left" if done > first else ""
        self._numbers = f"{text}{left}"
        self._print_if_due()

    def _print_if_due(self) -> None:
        if self._live is not None or self._quiet:
            return
        self._unprinted = time.monotonic() - self._last_print < self._plain_every
        if not self._unprinted:
            self._print(self._numbers)
            self._last_print = time.monotonic()

    def _print_pending(self) -> None:
        """Print the last numbers if they were not printed because they came too soon after others."""
        if self._unprinted:
            self._print(self._numbers)
            self._unprinted = False

    def warn(self, text: str) -> None:
        """Print a warning, even when quiet."""
        self._print(f"warning: {text}", style="yellow")

    def _print(self, text: str, style: str | None = None) -> None:
        self._console.print(harmless(text), style=style, markup=False)

    def _render(self) -> Text:
        return Text(
            harmless("  ".join(part for part in (self._phase, self._numbers) if part)),
            overflow="ellipsis",
            no_wrap=True,
        )


@contextmanager
def reporting(quiet: bool) -> Iterator[Progress]:
    """Show progress and handle Ctrl-C and SIGTERM while a job runs.

    Raises:
        Stopped: at the second signal, which aborts the job at once.
    """
    with Progress(quiet=quiet) as progress, progress.stop:
        try:
            yield progress
        except KeyboardInterrupt:
            message = "aborted; the same command continues from the last checkpoint"
            raise progress.stop.stopped(message) from None


def clock(seconds: float) -> str:
    """Return a duration as text: `42 s`, `3:07` or `1:02:09`."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
