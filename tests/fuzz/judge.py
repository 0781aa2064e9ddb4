"""Judge scenes in a process with limits: `python judge.py SCENES MEGABYTES SECONDS`, names of scenes on standard input.

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
from pathlib import Path
from types import SimpleNamespace

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


def main(folder: Path, megabytes: int, seconds: float) -> None:
    """Judge every scene that standard input names."""
    limit = psutil.Process().memory_info().vms + megabytes * 2**20
    free = SimpleNamespace(available=megabytes * 2**19, total=megabytes * 2**20)  # what cqrun plans with
    psutil.virtual_memory = lambda: free
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    faulthandler.enable()
    faulthandler.register(signal.SIGPROF, chain=True)  # time of the processor: a test may have to wait for one
    for name in map(str.strip, sys.stdin):
        signal.setitimer(signal.ITIMER_PROF, seconds)
        found = fault(folder / name)
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        print(json.dumps([name, found]), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]))
