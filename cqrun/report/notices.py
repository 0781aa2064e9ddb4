"""Section: what went wrong, and what a reader must know before using the numbers."""

from __future__ import annotations

from collections.abc import Iterator

from cqrun.learning.learned import blown_up
from cqrun.report.blocks import Block, Notes
from cqrun.report.subject import Subject
from cqrun.store.result import LearnedResult, SysidResult

ENDS = {
    "new": "The run has not begun.",
    "running": "The run has not ended: it is still running, or its process was killed. `cqrun resume` continues it.",
    "stopped": "The run was stopped before it ended. `cqrun resume` continues it.",
    "iteration_limit": "The run ended at its largest number of iterations, before it converged.",
    "stalled": "The search stopped without progress before it converged.",
    "infeasible": "No solution was found that meets all constraints.",
    "failed": "The run failed.",
}
"""What each status means, if the run did not end as it should."""


def notices(subject: Subject) -> Iterator[Block]:
    """Yield everything that a reader must not miss."""
    warnings = subject.run.record.get("warnings")
    before = warnings if isinstance(warnings, list) else []
    sentences = [*_of_status(subject), *before, *_of_result(subject)]
    if subject.run.record.get("extended"):
        sentences.append("The run was given more iterations than its scene has (`cqrun resume -o`).")
    if subject.why:
        sentences.append(f"There are no pictures: {subject.why}")
    if sentences:
        yield Notes(sentences)


def _of_status(subject: Subject) -> Iterator[str]:
    status, reason = str(subject.run.record["status"]), subject.run.record.get("reason")
    if status in ENDS:
        told = f" {str(reason)[:1].upper()}{str(reason)[1:]}" if reason and status != "iteration_limit" else ""
        yield ENDS[status] + told


def _of_result(subject: Subject) -> Iterator[str]:
    """Yield the findings of a result word by word, and why numbers have no interval."""
    result = subject.run.result
    if isinstance(result, SysidResult):
        reasons = {path: unknown.reason for path, unknown in result.unknowns.items() if unknown.reason}
        if len(reasons) > 1 and len(reasons) == len(result.unknowns) and len(set(reasons.values())) == 1:
            yield f"There are no intervals: {next(iter(reasons.values()))}"
        else:
            yield from (f"There is no interval for {path}: {reason}" for path, reason in reasons.items())
    if isinstance(result, LearnedResult):
        yield from blown_up(result)
        yield from (
            f"The constraint {name} is violated by {value.violation:.3g}."
            for name, value in result.constraints.items() if value.violation > 0
        )  # fmt: skip
    yield from getattr(result, "findings", [])
