"""Run a command that ends when the process that started it ends: `python -m cqrun.running.bound COMMAND ...`.

A worker of a cluster that is killed cannot stop the run that it started. This run would go on beside the one of the
worker that takes over. On Linux the system ends it (prctl). Elsewhere it goes on, and the other one waits for its lock.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

PR_SET_PDEATHSIG = 1


def main() -> None:
    """Bind this process to its parent, and become the command."""
    if sys.platform == "linux":
        parent = os.getppid()
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        if os.getppid() != parent:  # it ended before this process was bound to it
            os.kill(os.getpid(), signal.SIGKILL)
    os.execv(sys.argv[1], sys.argv[1:])


if __name__ == "__main__":
    main()
