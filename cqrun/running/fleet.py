"""Runs side by side, each a process of its own that can be stopped and resumed as any other run."""

from __future__ import annotations

import signal
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from cqrun.running.reporter import EXIT_INTERRUPTED, Reporter
from cqrun.store.lock import held

EVERY = 0.2
"""Time between two looks at the processes [s]."""


@dataclass
class Member:
    """One run: its name, directory and command, how it failed if it did, and its process while there is one."""

    name: str
    run: Path
    command: Sequence[str]
    iterations: int
    failure: str | None = None
    process: subprocess.Popen[bytes] | None = None
    said: IO[bytes] | None = None

    @property
    def iteration(self) -> int:
        """How many iterations its history has."""
        history = self.run / "history.csv"
        return max(0, history.read_bytes().count(b"\n") - 2) if history.is_file() else 0

    def start(self) -> None:
        """Begin; out of reach of the terminal's Ctrl-C, which this process hands on once."""
        self.said = tempfile.TemporaryFile()  # noqa: SIM115  closed when the process is over
        self.process = subprocess.Popen(
            self.command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=self.said, start_new_session=True
        )

    def ask(self, number: signal.Signals) -> None:
        """Ask it to stop at the next iteration."""
        if self.process is not None:
            self.process.send_signal(number)

    def ended(self) -> bool:
        """Say whether its process is over; a failure is known then."""
        return self.process is not None and self.process.poll() is not None and self._take_leave()

    def kill(self) -> None:
        """End it where it stands: it can be resumed from its last checkpoint."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self._take_leave()

    def _take_leave(self) -> bool:
        assert self.process is not None
        assert self.said is not None
        code = self.process.returncode
        if code < 0:  # what it said before is not why
            self.failure = f"was killed ({signal.Signals(-code).name}); the same command goes on with it"
        elif code > 0:
            self.said.seek(0)
            lines = self.said.read().decode(errors="replace").strip().splitlines()
            self.failure = lines[-1].removeprefix("error: ") if lines else f"ended with {code}"
        self.said.close()
        self.process = self.said = None
        return True


def run_fleet(members: Sequence[Member], at_once: int, what: str, talk: Reporter) -> None:
    """Run every member's process; a first request to stop is handed on, and none begins after it.

    A run that another process works on is waited for: a command that was killed leaves its runs behind, and they go on.

    Args:
        at_once: how many processes at once.
        what: members are called, such as `seeds`.
    """
    waiting, running, told, asked = list(members), list[Member](), set[str](), False
    try:
        while waiting or running:
            if talk.stop.asked and not asked:
                asked = True
                for member in waiting:
                    member.failure = "not begun"
                waiting.clear()
                for member in running:
                    member.ask(signal.SIGINT if talk.stop.exit_code == EXIT_INTERRUPTED else signal.SIGTERM)
            for member in [m for m in waiting if not held(m.run)][: at_once - len(running)]:
                waiting.remove(member)
                running.append(member)
                member.start()
            if len(running) < at_once:  # those left are held
                for member in waiting:
                    if member.name not in told:
                        talk.warn(f"{member.name}: another process works on it ({member.run}); waiting for its end")
                told |= {member.name for member in waiting}
            for member in [m for m in running if m.ended()]:
                running.remove(member)
                if member.failure is not None and not asked:
                    talk.warn(f"{member.name}: {member.failure}")
            if not asked:
                _tell(members, running, waiting, what, talk)
            if running or waiting:
                time.sleep(EVERY)
    finally:  # after a second Ctrl-C, or an error here
        for member in running:
            member.kill()


def _tell(
    members: Sequence[Member], running: Sequence[Member], waiting: Sequence[Member], what: str, talk: Reporter
) -> None:
    """Report one line for all."""
    over = [m for m in members if m not in running and m not in waiting]
    reached = [f"{m.name} at {m.iteration}/{m.iterations}" for m in running]
    done = sum(m.iterations for m in over) + sum(m.iteration for m in running)
    total = sum(m.iterations for m in members)
    talk.advance(done, total, ", ".join([f"{len(over)} of {len(members)} {what}", *reached]))
