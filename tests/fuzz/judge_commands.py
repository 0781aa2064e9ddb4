"""Give commands in a process with limits: `python judge_commands.py MEGABYTES SECONDS`, words as JSON on its input.

Of every command: its exit code, and what it printed as an error, or the traceback in which it ended.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
import traceback

from judge import judge_lines

from cqrun.cli.app import main


def answer(words: str) -> tuple[int | None, str]:
    """Return the exit code of a command and its standard error; no code and a traceback if it ended in one."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            main(json.loads(words))
    except SystemExit as end:
        return int(end.code or 0), said.getvalue()
    except BaseException:
        return None, traceback.format_exc()
    raise AssertionError("a command returned")


if __name__ == "__main__":
    judge_lines(answer, int(sys.argv[1]), float(sys.argv[2]))
