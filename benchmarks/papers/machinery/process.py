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

ROOT = Path(__file__).parents[3]

UNDRAWN = {PICTURES: "0"}
"""In a command's environment: its runs are drawn when their figure is, and not before."""

FAILED, USAGE, STOPPED = 1, 2, 75
"""How cqrun ends: runs failed or no design will do, which is a result too; bad input; it was asked to stop."""

HELD = "another process works on this run"
"""What cqrun says of such a run: one that goes on though who began it was killed, as a rule."""

GRACE = 120.0
"""Seconds that a run has to finish its iteration when its time is over."""

LOOK = 60.0
"""Seconds between two lines that say how far long work is, or two looks at a run that another process holds."""

BEAT = 0.5
"""Seconds between two looks at whether everything is over."""

OVER = threading.Event()
"""Set when everything is asked to stop."""


def nothing(*_: object) -> None:
    """Tell nothing, and look at nothing."""


def for_so_long(
    command: list[str], end: float, tell: Callable[[], None] = nothing, look: Callable[[int], None] = nothing
) -> tuple[int, str]:
    """Run a command, telling how far it is and looking at its process; ask it to stop when its time is over.

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
                look(process.pid)
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


def when_free(
    name: str, command: list[str], end: float, tell: Callable[[], None] = nothing, look: Callable[[int], None] = nothing
) -> tuple[int, str]:
    """Run a command as `for_so_long` does, once no other process holds its run."""
    code, said = for_so_long(command, end, tell, look)
    while code in (FAILED, USAGE) and HELD in said:
        print(f"    {name}: {said.strip()}\n    waiting for it", flush=True)
        if OVER.wait(min(LOOK, max(0.0, end - time.monotonic()))) or time.monotonic() >= end:
            return STOPPED, said
        code, said = for_so_long(command, end, tell, look)
    return code, said


def with_memory(name: str, command: list[str], end: float) -> tuple[int, str, float]:
    """Run a command as `when_free` does; return also the most memory it had [GB], 0 if not told."""
    memory = 0.0

    def look(pid: int) -> None:
        nonlocal memory
        memory = _peak(pid, memory)

    code, said = when_free(name, command, end, look=look)
    return code, said, memory


def _peak(pid: int, before: float) -> float:
    """Return the most memory that a process had so far [GB], or what was known before (Linux).

    wait4 tells more than its own: a child begins with what its parent had.
    """
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return before
    return next((1.024e-6 * float(line.split()[1]) for line in lines if line.startswith("VmHWM:")), before)
