"""How a job talks while it runs, and how it is asked to stop.

A job knows nothing of terminals: it calls a `Reporter` that the caller passes in. The command
line passes a progress line; Python callers get `Silent`.
"""

from __future__ import annotations

import signal
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any, Protocol

from cqrun.errors import Stopped

EXIT_INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells use it."""


class StopFlag:
    """Set by the first SIGINT or SIGTERM; a job looks at it after each iteration.

    As a context manager it listens to both signals: the first asks the job to finish its
    iteration and checkpoint, the second raises KeyboardInterrupt at once. Outside a context
    it is never set by a signal, only by `ask`.

        if reporter.stop.asked:
            checkpoint()
            raise reporter.stop.stopped("stopped after iteration 7; `cqrun resume RUN` continues")

    Args:
        announce: called with one sentence when the first signal arrives.
    """

    def __init__(self, announce: Callable[[str], None] | None = None) -> None:
        self._announce = announce
        self._signal: int | None = None
        self._previous: dict[int, Any] = {}

    @property
    def asked(self) -> bool:
        """True once the job should stop."""
        return self._signal is not None

    @property
    def exit_code(self) -> int:
        """130 after Ctrl-C, otherwise that of `Stopped`: stopped, and can be resumed."""
        return EXIT_INTERRUPTED if self._signal == signal.SIGINT else Stopped.exit_code

    def ask(self, signum: int = signal.SIGTERM) -> None:
        """Ask the job to stop, as `signum` would."""
        self._signal = signum

    def stopped(self, message: str) -> Stopped:
        """Return the error a job ends with once it has checkpointed; its exit code fits the signal."""
        error = Stopped(message)
        error.exit_code = self.exit_code
        return error

    def __enter__(self) -> StopFlag:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._previous[number] = signal.signal(number, self._receive)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous.clear()

    def _receive(self, signum: int, frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.ask(signum)
        if self._announce is not None:
            self._announce("finishing this iteration, then stopping (once more: abort now)")


class Reporter(Protocol):
    """What a job may tell, and the flag that it must heed."""

    stop: StopFlag

    def begin(self, total: int) -> None:
        """Say how many iterations are to come at most."""

    def phase(self, text: str) -> None:
        """Name what happens now, such as `compiling kernels (once, about 40 s)`."""

    def say(self, text: str) -> None:
        """Tell a fact that stays to be read."""

    def update(
        self, iteration: int, loss: float, best: float, step: float, seconds: float, violation: float | None = None
    ) -> None:
        """Report a finished iteration.

        Args:
            iteration: its number, from 1.
            loss: the objective at the accepted point.
            best: the least objective so far.
            step: length of the step in the optimizer's variables.
            seconds: how long the iteration took [s].
            violation: the largest of a constraint, where there are any; then `best` means nothing.
        """

    def advance(self, done: int, total: int, text: str) -> None:
        """Report how far a piece of work with a known end is.

        Args:
            done: parts that are done.
            total: how many there are.
            text: what has been reached, such as `t = 0.31 of 1.5 s`.
        """

    def warn(self, text: str) -> None:
        """Tell something the user should know although the job goes on."""


class Silent:
    """The reporter that says nothing; its flag is set only by whoever holds it."""

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
