"""Several runs at once: each is a separate process that can be stopped and resumed like any other run."""

from __future__ import annotations

import signal
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from cqrun.running.reporter import Reporter
from cqrun.store.lock import is_locked

POLL_INTERVAL = 0.2
"""Time between two checks of the processes [s]."""


GOES_ON = "the same command goes on with it"


def reason_in(message: str, run: Path) -> str:
    """Return a command's last message as the reason why its run ended, without the run."""
    return message.removeprefix("error: ").removeprefix(f"{run}: ")


@dataclass
class Member:
    """One run of a fleet.

    Attributes:
        name: such as `seed 3`.
        run: directory of the run.
        command: command line that starts or continues it.
        iterations: number of iterations at most.
        failure: why it failed, without the run's name; or None.
        process: its process while that runs.
        stderr: what the process writes to standard error.
    """

    name: str
    run: Path
    command: Sequence[str]
    iterations: int
    failure: str | None = None
    process: subprocess.Popen[bytes] | None = None
    stderr: IO[bytes] | None = None

    @property
    def iteration(self) -> int:
        """Number of iterations in its history."""
        history = self.run / "history.csv"
        return max(0, history.read_bytes().count(b"\n") - 2) if history.is_file() else 0

    def start(self) -> None:
        """Start the process in a session of its own, so that the terminal's Ctrl-C reaches this process only."""
        self.stderr = tempfile.TemporaryFile()  # noqa: SIM115  closed when the process has ended
        self.process = subprocess.Popen(
            self.command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self.stderr,
            start_new_session=True,
        )

    def request_stop(self, number: signal.Signals) -> None:
        """Ask the process to stop after its current iteration."""
        if self.process is not None:
            self.process.send_signal(number)

    def has_ended(self) -> bool:
        """Return whether its process has ended; then `failure` is set if it failed."""
        return self.process is not None and self.process.poll() is not None and self._record_end()

    def kill(self) -> None:
        """Kill the process; the run can be resumed from its last checkpoint."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self._record_end()

    def _record_end(self) -> bool:
        assert self.process is not None
        assert self.stderr is not None
        code = self.process.returncode
        if code < 0:  # its last message is not the reason
            self.failure = f"was killed ({signal.Signals(-code).name}); {GOES_ON}"
        elif code > 0:
            self.stderr.seek(0)
            lines = self.stderr.read().decode(errors="replace").strip().splitlines()
            self.failure = reason_in(lines[-1], self.run) if lines else f"ended with exit code {code}"
        self.stderr.close()
        self.process = self.stderr = None
        return True


def run_fleet(members: Sequence[Member], at_once: int, what: str, reporter: Reporter) -> None:
    """Run the process of every member; pass a request to stop on to all of them, and start no others after it.

    If another process works on a run, wait for it: when a command is killed, the runs that it started continue.

    Args:
        at_once: number of processes at once.
        what: what the members are called, such as `seeds`.
        reporter: receives the progress, failures and warnings.
    """
    with reporter.stop.deferred():
        _run_all(members, at_once, what, reporter)


def _run_all(members: Sequence[Member], at_once: int, what: str, reporter: Reporter) -> None:
    waiting, running, announced, stopping = list(members), list[Member](), set[str](), False
    try:
        while waiting or running:
            if reporter.stop.asked and not stopping:
                stopping = True
                for member in waiting:
                    member.failure = "not started"
                waiting.clear()
                for member in running:
                    member.request_stop(reporter.stop.signum)
            for member in [m for m in waiting if not is_locked(m.run)][: at_once - len(running)]:
                waiting.remove(member)
                running.append(member)
                member.start()
            if len(running) < at_once:  # other processes work on those that still wait
                for member in waiting:
                    if member.name not in announced:
                        reporter.warn(
                            f"{member.name} ({member.run}): another process works on it; waiting until it ends"
                        )
                announced |= {member.name for member in waiting}
            for member in [m for m in running if m.has_ended()]:
                running.remove(member)
                if member.failure is not None and not stopping:
                    reporter.warn(f"{member.name} ({member.run}): {member.failure}")
            if not stopping:
                report_progress(members, running, waiting, what, reporter)
            if running or waiting:
                time.sleep(POLL_INTERVAL)
    finally:  # after a second signal, or an error here
        for member in running:
            member.kill()


def report_progress(
    members: Sequence[Member], running: Sequence[Member], waiting: Sequence[Member], what: str, reporter: Reporter
) -> None:
    """Report the progress of all members in one line."""
    finished = [m for m in members if m not in running and m not in waiting]
    reached = [f"{m.name} at {m.iteration}/{m.iterations}" if m.iterations > 1 else m.name for m in running]
    done = sum(m.iterations for m in finished) + sum(m.iteration for m in running)
    total = sum(m.iterations for m in members)
    reporter.advance(done, total, ", ".join([f"{len(finished)} of {len(members)} {what}", *reached]))
