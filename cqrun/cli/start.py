"""Where the command `cqrun` begins: what must hold before anything long is imported.

- A request to stop is answered from the first moment on.
- Python imports nothing from the folder that the user works in: a `yaml.py` beside a stranger's scene is not a library.
- What the user's environment tells other programs does not reach the libraries that compute and draw.

A caller of cqrun in Python keeps signals, paths and environment as they are.
"""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from typing import Any, NoReturn

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.realpath(__file__))))
"""Folder of the package."""

SET = {"MPLBACKEND": "agg", "HDF5_USE_FILE_LOCKING": "FALSE"} | dict.fromkeys(
    ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)
"""Pictures go to files, whatever a notebook has set. A run has a lock, so HDF5 needs none. BLAS on one thread always
adds in the same order, and its threads do not busy-wait after each call, on cores that rollouts need."""

OF_NUMBA = {"NUMBA_CACHE_DIR", "NUMBA_DISABLE_JIT"}
"""Variables of Numba that count. Others change the code of kernels, which the cache keeps for later processes."""

NUMBA_THREADS, MOST_THREADS = "NUMBA_NUM_THREADS", "CQRUN_MOST_THREADS"
"""Numba has no threads here, but cqrun does: the first variable bounds their number, if `--threads` is not given. Its
value goes to the second one, which `running/threads.py` reads."""

NUMBA_FILE = ".numba_config.yaml"


def main() -> NoReturn:
    """Run the command line of this process and exit."""
    leave_the_current_folder()
    import signal

    numbers = [signal.SIGHUP, signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:  # under nohup
        del numbers[0]
    for number in numbers:
        signal.signal(number, _stop_at_once)
    warning = set_environment()
    if warning:
        print(f"warning: {warning}", file=sys.stderr)
    if os.path.exists(NUMBA_FILE):
        print(
            f"error: {NUMBA_FILE}: Numba would read this file, and results would depend on it; rename it, or work in "
            "another folder",
            file=sys.stderr,
        )
        sys.exit(2)
    from cqrun.cli import app

    try:
        app.main()
    finally:  # the results are there and printed: what is left is the end of the process
        for number in numbers:
            signal.signal(number, signal.SIG_IGN)


def _stop_at_once(number: int, frame: Any) -> NoReturn:
    """End the process, which has not begun to do anything."""
    name = {1: "SIGHUP", 2: "SIGINT (Ctrl-C)"}.get(number, "SIGTERM")
    with suppress(OSError):  # the terminal is gone
        os.write(2, f"error: {name}: stopped before it began; give the command again\n".encode())
    os._exit(130 if number == 2 else 75)


def leave_the_current_folder() -> None:
    """Import nothing from the current folder, neither in this process nor in a Python that it starts.

    `python -m` does, and relative or empty entries of PYTHONPATH do. In a checkout that is not installed, cqrun itself
    lies there: then that folder is searched last.
    """
    try:
        here = os.getcwd()
    except FileNotFoundError:  # it was deleted, and nothing can be imported from it
        return
    if not sys.flags.safe_path and sys.path[:1] in ([here], [""]):
        del sys.path[0]
    given = os.environ["PYTHONPATH"].split(os.pathsep) if os.environ.get("PYTHONPATH") else []
    relative = [path for path in given if not os.path.isabs(path)]
    relative += [os.path.normpath(os.path.join(here, path)) for path in relative]
    sys.path[:] = [path for path in sys.path if path not in relative]
    kept = [path for path in given if os.path.isabs(path)]
    if ROOT not in map(os.path.realpath, sys.path):
        sys.path.append(ROOT)
        kept.append(ROOT)
    os.environ["PYTHONSAFEPATH"] = "1"
    if kept or given:
        os.environ["PYTHONPATH"] = os.pathsep.join(kept)


def set_environment() -> str:
    """Set what the user's environment tells libraries; return a warning about what is ignored, or an empty text."""
    os.environ |= SET
    _speak()
    if sys.warnoptions:  # PYTHONWARNINGS and -W are for the authors of libraries; `error` would end a run
        import warnings

        os.environ.pop("PYTHONWARNINGS", None)
        warnings.resetwarnings()
        for category in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning):
            warnings.simplefilter("ignore", category)
    names = [name for name in os.environ if name.startswith("NUMBA_") and name not in OF_NUMBA]
    most = os.environ.get(NUMBA_THREADS, "")
    for name in names:
        del os.environ[name]
    if most.isdecimal() and int(most) >= 1:
        os.environ[MOST_THREADS] = most
        names.remove(NUMBA_THREADS)
    told = ", ".join(sorted(names))
    return f"{told} in the environment: not used, as results would depend on it" if told else ""


def _speak() -> None:
    """Print every text, whatever the terminal's encoding: bytes of file names as they are, other signs in ASCII."""
    import codecs

    def as_bytes(error: UnicodeError) -> tuple[bytes, int]:
        assert isinstance(error, UnicodeEncodeError)
        signs = error.object[error.start : error.end]
        return b"".join(
            bytes([ord(sign) - 0xDC00]) if 0xDC80 <= ord(sign) <= 0xDCFF else sign.encode("ascii", "backslashreplace")
            for sign in signs
        ), error.end

    codecs.register_error("as_bytes", as_bytes)
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.reconfigure(errors="as_bytes")  # type: ignore[union-attr]
