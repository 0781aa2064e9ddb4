"""Show progress on standard error: one live line on a terminal, or else a plain line from time to time.

Whatever the work does, something is said every few seconds: a live line shows the time, and a plain one is repeated.
A plain line begins with the time of day, as in a log; warnings do not, because programs look for their places.
Results are printed on standard output by other modules. Colours follow NO_COLOR.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO

from rich.console import Console
from rich.live import Live
from rich.text import Text

from cqrun.characters import harmless, printable
from cqrun.cli.terminal import Closable
from cqrun.errors import StopNow
from cqrun.running.reporter import StopFlag

PLAIN_EVERY = 5.0
"""Shortest time between two plain progress lines [s], so that log files remain readable."""

SILENT_AT_MOST = 8.0
"""Longest time without a line [s]."""

BRIEF = 1.0
"""A first phase that is shorter is not printed [s]: most commands take a moment to read their input."""

AGAIN = "stopped before it was finished; give the command again"


class Progress:
    """A `cqrun.running.reporter.Reporter` that prints for people; use it as a context manager.

    Args:
        total: largest number of iterations, if it is known.
        quiet: print only warnings.
        stream: stream to print to; standard error if not given.
        plain_every: shortest time between two plain lines [s].
        silent_at_most: longest time without a line [s].
        doing: what is done first; a plain line says so only if it lasts.
    """

    def __init__(
        self,
        total: int | None = None,
        quiet: bool = False,
        stream: TextIO | None = None,
        plain_every: float = PLAIN_EVERY,
        silent_at_most: float = SILENT_AT_MOST,
        doing: str = "",
    ) -> None:
        self.stop = StopFlag(announce=self.warn)
        # no emoji: `:100:` in the place `scene.yaml:100:53` is the name of one
        file: Any = Closable(stream or sys.stderr)
        self._console = Console(file=file, highlight=False, soft_wrap=True, emoji=False)
        self._quiet = quiet
        self._plain_every, self._silent_at_most = plain_every, silent_at_most
        self._unsaid = bool(doing)
        self._total = total
        self._phase = doing
        self._phase_began = self._last_line = time.monotonic()
        self._numbers = self._left = ""
        self._unprinted = False
        self._last_print = float("-inf")
        self._ended = threading.Event()
        self._began: tuple[int, float] | None = None
        live = self._console.is_terminal and not self._console.is_dumb_terminal and not quiet
        self._live: Live | None = None
        if live:  # what a job prints meanwhile goes above the line, unless it goes to a file
            above = sys.stdout.isatty()
            self._live = Live(console=self._console, get_renderable=self._render, transient=True, redirect_stdout=above)

    def __enter__(self) -> Progress:
        if self._live is not None:
            self._live.start()
        elif not self._quiet:
            threading.Thread(target=self._break_silences, daemon=True).start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._ended.set()
        if self._live is not None:
            self._live.stop()
        self._print_pending()

    def begin(self, total: int) -> None:
        """Set how many iterations there will be at most."""
        self._total = total

    def phase(self, text: str) -> None:
        """Show what happens now, in one line, whatever the name of a file contains."""
        text, self._unsaid = printable(text), False
        self._print_pending()
        self._phase, self._numbers, self._left = text, "", ""
        self._began, self._phase_began = None, time.monotonic()
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
            left = f"{clock(max(self._total - iteration, 0) * seconds)} left"
        best_text = f"best {best:.6g}" if violation is None else f"violation {violation:.3g}"
        self._numbers = (
            f"iteration {iteration}{of}  loss {loss:.6g}  {best_text}  step {step:.3g}  {seconds:.3g} s/iteration"
        )
        self._left = left
        self._print_if_due()

    def advance(self, done: int, total: int, text: str) -> None:
        """Show the progress of the work and an estimate of the remaining time; arguments as in `Reporter`."""
        now = time.monotonic()
        first, began = self._began = self._began or (done, now)
        self._left = f"{clock((total - done) * (now - began) / (done - first))} left" if done > first else ""
        self._numbers = text
        self._print_if_due()

    @property
    def _plain(self) -> str:
        """The last numbers, and the remaining time if it is known."""
        return "  ".join(part for part in (self._numbers, self._left) if part)

    def _print_if_due(self) -> None:
        if self._live is not None or self._quiet:
            return
        self._unprinted = time.monotonic() - self._last_print < self._plain_every
        if not self._unprinted:
            self._print(self._plain)
            self._last_print = time.monotonic()

    def _print_pending(self) -> None:
        """Print the last numbers if they were not printed because they came too soon after others."""
        if self._unprinted:
            self._print(self._plain)
            self._unprinted = False

    def warn(self, text: str) -> None:
        """Print a warning, even when quiet."""
        self._last_line = time.monotonic()
        self._console.print(harmless(f"warning: {text}"), style="yellow", markup=False)

    def _print(self, text: str) -> None:
        self._last_line = time.monotonic()
        now = "" if self._console.is_terminal else time.strftime("%H:%M:%S  ")
        self._console.print(f"{now}{harmless(text)}", markup=False)

    def _break_silences(self) -> None:
        """Repeat what is being done when nothing has been printed for a while, until the work ends."""
        while not self._ended.wait(min(0.25, 0.25 * self._silent_at_most)):
            now = time.monotonic()
            if self._unsaid and now - self._phase_began >= BRIEF:
                self.phase(self._phase)
            elif self._phase and not self._unsaid and now - self._last_line >= self._silent_at_most:
                last = f"; last: {self._plain}" if self._numbers else ""
                self._print(f"still {self._phase}: {clock(now - self._phase_began)} so far{last}")

    def _render(self) -> Text:
        """Return the live line: the times first, then the numbers, because the end is cut in a narrow window."""
        lasts = clock(time.monotonic() - self._phase_began)
        shown = f"[{', '.join(part for part in (lasts, self._left) if part)}]"
        return Text(
            harmless("  ".join(part for part in (shown, self._numbers, self._phase) if part)),
            overflow="ellipsis",
            no_wrap=True,
        )


@contextmanager
def reporting(quiet: bool, doing: str = "", stopped: str = AGAIN) -> Iterator[Progress]:
    """Show progress and handle Ctrl-C and SIGTERM while a job runs.

    Args:
        doing: what is done first, before the job's libraries are imported.
        stopped: what to say if a signal ends the job at once.

    Raises:
        Stopped: a signal ended the job at once.
    """
    with Progress(quiet=quiet, doing=doing) as progress, progress.stop:
        try:
            yield progress
        except StopNow as now:
            raise progress.stop.stopped(str(now) or stopped) from None


@contextmanager
def working(quiet: bool, allow_plugins: bool, doing: str, stopped: str = AGAIN) -> Iterator[Progress]:
    """Do the same as `reporting`, and allow or forbid that scenes run their plug-in files."""
    with reporting(quiet, doing, stopped) as reporter:
        from cqrun.scene.plugin_files import plugins_allowed

        with plugins_allowed(allow_plugins):
            yield reporter


def clock(seconds: float) -> str:
    """Return a duration as text: `42 s`, `3:07` or `1:02:09`."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
