"""A command of cqrun that is given some time: it is asked to stop when that, or everything, is over."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path

from cqrun.cli.results import PICTURES

ROOT = Path(__file__).parents[2]

UNDRAWN = {PICTURES: "0"}
"""In a command's environment: its runs are drawn when their figure is, and not before."""

FAILED, USAGE, STOPPED = 1, 2, 75
"""How cqrun ends: runs failed or no design will do, which is a result too; bad input; it was asked to stop."""

GRACE = 120.0
"""Seconds that a run has to finish its iteration when its time is over."""

LOOK = 60.0
"""Seconds between two lines that say how far long work is, or two looks at a run that another process holds."""

BEAT = 0.5
"""Seconds between two looks at whether everything is over."""

OVER = threading.Event()
"""Set when everything is asked to stop."""


def for_so_long(command: list[str], end: float, tell: Callable[[], None]) -> tuple[int, str]:
    """Run a command, telling how far it is; ask it to stop when its time is over.

    Return its exit status, STOPPED if it ended because it was asked to, and what it said.
    """
    process = subprocess.Popen(
        command, cwd=ROOT, env=os.environ | UNDRAWN, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    end, told = max(end, time.monotonic() + 1.0), time.monotonic()
    try:
        while (now := time.monotonic()) < end and not OVER.is_set():
            if now - told >= LOOK:
                tell()
                told = now
            try:
                said, _ = process.communicate(timeout=min(end - now, BEAT))
                return process.returncode, said
            except subprocess.TimeoutExpired:
                continue
        process.send_signal(signal.SIGTERM)
        try:
            said, _ = process.communicate(timeout=GRACE)
        except subprocess.TimeoutExpired:
            process.kill()
            said, _ = process.communicate()
        # it may have been asked before it could listen, and then ends by the signal itself
        return STOPPED if process.returncode < 0 else process.returncode, said
    except BaseException:
        process.send_signal(signal.SIGTERM)
        process.wait()
        raise


def with_memory(command: list[str]) -> tuple[int, float]:
    """Run a command that prints nothing; return its exit status and the most memory it had [GB], 0 if not told."""
    process = subprocess.Popen(command, cwd=ROOT, env=os.environ | UNDRAWN, stdout=subprocess.DEVNULL)
    memory = 0.0
    while process.poll() is None:
        if OVER.is_set():
            process.terminate()
        memory = _peak(process.pid, memory)
        time.sleep(BEAT)
    return process.returncode, memory


def _peak(pid: int, before: float) -> float:
    """Return the most memory that a process had so far [GB], or what was known before (Linux).

    wait4 tells more than its own: a child begins with what its parent had.
    """
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return before
    return next((1.024e-6 * float(line.split()[1]) for line in lines if line.startswith("VmHWM:")), before)
