"""How a job reports its progress, and how it is asked to stop.

A job does not know about terminals: it calls a `Reporter` that its caller passes in. The command line passes a progress
line, and Python callers get `Silent`.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType, TracebackType
from typing import Any, Protocol

from cqrun.errors import StopAsked, StopNow, Stopped

EXIT_INTERRUPTED = 130
"""Exit code after Ctrl-C, the same as in shells."""

ABORTED = "aborted; the same command continues from what was kept"


SIGNALS = {signal.SIGINT: "SIGINT (Ctrl-C)", signal.SIGTERM: "SIGTERM", signal.SIGHUP: "SIGHUP (the terminal is gone)"}
"""Signals that ask to stop, and what messages call them."""


class StopFlag:
    """A request to stop, by a signal or `ask`.

    As a context manager it handles SIGNALS: each raises StopNow at once. Inside `deferred()` the first one only sets
    the flag, which the work asks for between two rollouts, and the second raises StopNow. SIGHUP is left alone where it
    is ignored, as under `nohup`.

        with reporter.stop.deferred():
            for rollout in rollouts:
                reporter.stop.check()

    Args:
        announce: called with one sentence when the first signal arrives and is deferred.
    """

    def __init__(self, announce: Callable[[str], None] | None = None) -> None:
        self._announce = announce
        self._asked = False
        self._signal: int | None = None
        self._deferred = False
        self._previous: dict[int, Any] = {}

    @property
    def asked(self) -> bool:
        """Whether the job should stop."""
        return self._asked

    @property
    def signum(self) -> signal.Signals:
        """The signal that asked; SIGTERM if none did."""
        return signal.SIGTERM if self._signal is None else signal.Signals(self._signal)

    @property
    def exit_code(self) -> int:
        """130 after Ctrl-C, otherwise the exit code of `Stopped`: stopped, and can be resumed."""
        return EXIT_INTERRUPTED if self._signal == signal.SIGINT else Stopped.exit_code

    def ask(self, signum: int | None = None) -> None:
        """Ask the job to stop, as the signal `signum` does if one is given."""
        self._asked, self._signal = True, signum

    def check(self) -> None:
        """Raise StopAsked if the job should stop."""
        if self.asked:
            raise StopAsked

    def named(self, reason: str) -> str:
        """Return the reason why a job ended, with the signal that asked for it, if one did."""
        return reason if self._signal is None else f"{SIGNALS[self.signum]}: {reason}"

    def stopped(self, message: str) -> Stopped:
        """Return the error that a job raises after its checkpoint; it names the signal, and its exit code fits."""
        error = Stopped(self.named(message))
        error.exit_code = self.exit_code
        return error

    @contextmanager
    def deferred(self, deferred: bool = True) -> Iterator[None]:
        """Let the work inside end by itself when it is asked to stop; with False, end it at once again."""
        before, self._deferred = self._deferred, deferred
        try:
            if not deferred:
                self.check()
            yield
        finally:
            self._deferred = before

    def __enter__(self) -> StopFlag:
        for number in SIGNALS:
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                self._previous[number] = signal.signal(number, self._receive)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous.clear()

    def _receive(self, signum: int, frame: FrameType | None) -> None:
        first = not self.asked
        self.ask(signum)
        if not (first and self._deferred):
            raise StopNow("" if first else ABORTED)
        if self._announce is not None:
            with suppress(RuntimeError):  # the signal came while the same stream was written to
                self._announce("stopping after the rollout at hand (once more: abort now)")


class Reporter(Protocol):
    """What a job reports, and the flag that it must check."""

    stop: StopFlag

    def begin(self, total: int) -> None:
        """Report how many iterations there will be at most."""

    def phase(self, text: str) -> None:
        """Report what happens now, such as `compiling kernels (once, about 40 s)`."""

    def say(self, text: str) -> None:
        """Report a fact that stays visible."""

    def update(
        self, iteration: int, loss: float, best: float, step: float, seconds: float, violation: float | None = None
    ) -> None:
        """Report a finished iteration.

        Args:
            iteration: its number, from 1.
            loss: the objective at the accepted point.
            best: the smallest objective so far.
            step: length of the step in the optimizer's variables.
            seconds: duration of the iteration [s].
            violation: the largest violation of a constraint, if there are constraints; then `best` has no meaning.
        """

    def advance(self, done: int, total: int, text: str) -> None:
        """Report the progress of work with a known end.

        Args:
            done: number of parts that are done.
            total: number of all parts.
            text: what has been reached, such as `t = 0.31 of 1.5 s`.
        """

    def warn(self, text: str) -> None:
        """Report something that the user should know although the job continues."""


class Silent:
    """A reporter that prints nothing; only its owner can set its flag."""

    def __init__(self) -> None:
        self.stop = StopFlag()

    def begin(self, total: int) -> None:
        """Ignore the total."""

    def phase(self, text: str) -> None:
        """Ignore the phase."""

    def say(self, text: str) -> None:
        """Ignore the fact."""

    def update(
        self, iteration: int, loss: float, best: float, step: float, seconds: float, violation: float | None = None
    ) -> None:
        """Ignore the iteration."""

    def advance(self, done: int, total: int, text: str) -> None:
        """Ignore the part."""

    def warn(self, text: str) -> None:
        """Ignore the warning."""
