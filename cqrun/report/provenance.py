"""Sections: the scene and the command of a run, and where, when and with what it was made."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cqrun.characters import harmless
from cqrun.disk import open_file
from cqrun.errors import UsageError
from cqrun.jobs.table import job_of
from cqrun.report.blocks import Block, Code, Facts, Folded, Text
from cqrun.report.subject import MISSING, Subject
from cqrun.report.words import clipped, count
from cqrun.running.cost import duration
from cqrun.store.run import SCENE

ORIGINAL = "scene.original.yaml"

STARTED_AS = re.compile(r"(.*/)?cqrun(/__main__\.py)?", re.DOTALL)
"""The program when it was started as a command, `cqrun` or `python -m cqrun`."""

MOST_BYTES = 1 << 20
"""Bytes of a scene that are read, at most."""


def scene_and_command(subject: Subject) -> Iterator[Block]:
    """Yield the command as it was typed, the scene, and the report of the terminal."""
    words = command(subject.run.record)
    if words:
        yield Code(words)
    else:
        yield Text("The run was started from Python, so there is no command.")
    original = _text(subject.run.path / ORIGINAL)
    if original.strip():
        yield Folded("The scene as it was written", [Code(original)])
    yield Folded("The scene as it was run, with every default", [Code(_text(subject.run.path / SCENE))])
    result = subject.run.result
    if result is not None:
        lines = job_of(subject.run.path).lines(subject.run.path, result)
        yield Folded("The report at the terminal", [Code("\n".join(lines))])


def command(record: dict[str, Any]) -> str:
    """Return the command of a run as it was typed, without the place of the program; empty if it was not a command."""
    words = [str(word) for word in record.get("argv") or []]
    if not words or not STARTED_AS.fullmatch(words[0]):
        return ""
    return harmless(shlex.join(["cqrun", *words[1:]])).replace("\n", " ")


def _text(path: Path) -> str:
    """Return the text of a file of the run; empty if there is none.

    Raises:
        UsageError: it is a link.
    """
    try:
        with open_file(path) as file:
            return bytes(file.read(MOST_BYTES)).decode(errors="replace")
    except UsageError:
        raise
    except OSError:
        return ""


def made(subject: Subject) -> Iterator[Block]:
    """Yield the machine, the time and the versions of a run."""
    rows = [(name, clipped(text, 500)) for name, text in _facts(subject) if text and MISSING not in text]
    yield Facts(rows)


def _facts(subject: Subject) -> Iterator[tuple[str, str]]:
    record = subject.run.record
    yield "Status", subject.run.status + (f": {record['reason']}" if record.get("reason") else "")
    yield "Run", f"{subject.run.name}/{subject.run.path.resolve().name}"
    began = subject.fact("began")
    yield "Begun", f"{began[:10]} {began[11:16]} UTC" if began.endswith("+00:00") else began
    yield "Time taken", f"{duration(float(record['seconds']))} (without compiling kernels)"
    yield "Machine", _machine(subject)
    yield "Operating system", subject.fact("machine", "system")
    yield "cqrun", subject.fact("versions", "cqrun")
    yield "Engine", subject.fact("engine")
    yield "Source", _source(record.get("git"))
    versions = record.get("versions")
    others = {name: of for name, of in versions.items() if name != "cqrun"} if isinstance(versions, dict) else {}
    yield "Libraries", ", ".join(f"{'Python' if name == 'python' else name} {of}" for name, of in others.items())
    yield "Precision", subject.run.scene.precision
    yield "Seed", subject.fact("seed")


def _machine(subject: Subject) -> str:
    threads = subject.run.record.get("threads")
    used = f"{count(threads, 'thread')} of " if isinstance(threads, int) else ""
    cores, name = subject.fact("machine", "cores"), subject.fact("machine", "processor")
    if cores == MISSING:
        return count(threads, "thread") if isinstance(threads, int) else ""
    return f"{used}{cores} cores" + ("" if name == MISSING else f", {name}")


def _source(git: Any) -> str:
    if not isinstance(git, dict) or not git.get("commit"):
        return ""
    return f"commit {str(git['commit'])[:12]}" + (", with changes" if git.get("dirty") else "")
