"""Run a command of cqrun for a limited time."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from cqrun.cli.results import PICTURES

ROOT = Path(__file__).parents[3]

FAILED, USAGE, STOPPED = 1, 2, 75
"""Exit statuses of cqrun: runs failed, or no design is feasible (both are results); bad input; asked to stop."""

IN_USE = "another process works on this run"
"""What cqrun says if another process has the run, usually one whose parent was killed."""

GRACE = 120.0
"""Seconds that a command has to finish its iteration after it was asked to stop."""

REPORT_EVERY = 60.0
"""Seconds between two lines of progress, and between two attempts at a run that another process has."""

POLL_EVERY = 0.5
"""Seconds between two looks at the command and at STOP."""

STOP = threading.Event()
"""Set when every command is to stop."""


class Ended(NamedTuple):
    """How a command ended: exit status, output, and its peak memory [GB], 0 where that is not known."""

    status: int
    output: str
    memory: float


def run_command(name: str, command: list[str], deadline: float, report: Callable[[], None] | None = None) -> Ended:
    """Run a command until a deadline, then ask it to stop. Wait first while another process has its run.

    Args:
        name: what messages call it.
        deadline: of time.monotonic().
        report: prints a line of progress.

    Returns:
        How it ended; the status is STOPPED if it was asked to stop or had to wait too long.
    """
    ended = _run_once(command, deadline, report)
    while ended.status in (FAILED, USAGE) and IN_USE in ended.output:
        print(f"    {name}: {ended.output.strip()}\n    waiting for it", flush=True)
        if STOP.wait(min(REPORT_EVERY, max(0.0, deadline - time.monotonic()))) or time.monotonic() >= deadline:
            return ended._replace(status=STOPPED)
        ended = _run_once(command, deadline, report)
    return ended


def _run_once(command: list[str], deadline: float, report: Callable[[], None] | None = None) -> Ended:
    environment = os.environ | {PICTURES: "0"}  # the figure draws what the runs found
    process = subprocess.Popen(
        command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    deadline, reported, memory = max(deadline, time.monotonic() + 1.0), time.monotonic(), 0.0
    try:
        while (now := time.monotonic()) < deadline and not STOP.is_set():
            if report is not None and now - reported >= REPORT_EVERY:
                report()
                reported = now
            try:
                output, _ = process.communicate(timeout=min(deadline - now, POLL_EVERY))
                return Ended(process.returncode, output, memory)
            except subprocess.TimeoutExpired:
                memory = _peak_memory(process.pid, memory)
        process.send_signal(signal.SIGTERM)
        try:
            output, _ = process.communicate(timeout=GRACE)
        except subprocess.TimeoutExpired:
            process.kill()
            output, _ = process.communicate()
        # a process that was asked before it could listen ends by the signal itself
        return Ended(STOPPED if process.returncode < 0 else process.returncode, output, memory)
    except BaseException:
        process.send_signal(signal.SIGTERM)
        process.wait()
        raise


def _peak_memory(pid: int, before: float) -> float:
    """Return the peak memory of a process so far [GB]; what was known before if it cannot be read (Linux only).

    The kernel's own figure for ended children counts the memory that a child shared with its parent when it started.
    """
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return before
    return next((1.024e-6 * float(line.split()[1]) for line in lines if line.startswith("VmHWM:")), before)
