"""Judge scenes in a process with limits: `python judge.py MEGABYTES SECONDS SCENES`, names of scenes on standard input.

For every name, a line of JSON: the name, and what is wrong with how cqrun took the scene, or nothing. A scene that asks
for more memory ends in a MemoryError, which is reported; one that takes longer ends the process, with the place.
"""

from __future__ import annotations

import faulthandler
import json
import re
import resource
import signal
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil

from cqrun.errors import SceneError
from cqrun.jobs.validate import validate

_PLACE = re.compile(r"(?P<file>.+\.yaml)(:[1-9][0-9]*:[1-9][0-9]*)?")
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e]")


def fault(scene: Path) -> str:
    """Return what is wrong with how cqrun takes a scene, or an empty text."""
    try:
        lines = list(validate(scene))
    except SceneError as error:
        wrong = [p for p in error.problems if not (_PLACE.fullmatch(p.where) and p.message)]
        if not error.problems or wrong:
            return f"an error without a place: {wrong}"
        lines = str(error).splitlines()
        if len(lines) != len(error.problems):
            return f"an error of {len(error.problems)} problems has {len(lines)} lines: {lines[:3]}"
    except BaseException:
        return traceback.format_exc()
    strange = [line for line in lines if _CONTROL.search(line)]
    return f"control characters: {strange[0]!r}" if strange else ""


def judge_lines(judge: Callable[[str], Any], megabytes: int, seconds: float) -> None:
    """Print for every line of standard input a line of JSON: the input and what `judge` finds of it, within limits."""
    limit = psutil.Process().memory_info().vms + megabytes * 2**20
    free = SimpleNamespace(available=megabytes * 2**19, total=megabytes * 2**20)  # what cqrun plans with
    psutil.virtual_memory = lambda: free
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    faulthandler.enable()
    faulthandler.register(signal.SIGPROF, chain=True)  # time of the processor: a test may have to wait for one
    for line in map(str.strip, sys.stdin):
        signal.setitimer(signal.ITIMER_PROF, seconds)
        found = judge(line)
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        print(json.dumps([line, found]), flush=True)


if __name__ == "__main__":
    folder = Path(sys.argv[3])
    judge_lines(lambda name: fault(folder / name), int(sys.argv[1]), float(sys.argv[2]))
