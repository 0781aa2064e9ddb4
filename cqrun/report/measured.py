"""Section: what was measured against what the model predicts, for each recording."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from cqrun.report.blocks import Block, Picture, Table
from cqrun.report.subject import Subject
from cqrun.report.words import short
from cqrun.store.result import RecordingError, SysidResult

MOST_CHANNELS = 12
"""Errors of single channels (markers) in a cell, at most."""


def measured(subject: Subject) -> Iterator[Block]:
    """Yield the errors of every recording, and the pictures of data and model."""
    result = subject.run.result
    recordings = (result.recordings or {}) if isinstance(result, SysidResult) else {}
    rows = [_row(subject, name, error) for name, error in recordings.items()]
    if rows:
        yield Table(
            ("recording", "used for", "measured", "RMSE", "by channel"), rows,
            "RMSE: root mean square distance between data and model", rest="in result.json",
        )  # fmt: skip
    for path in subject.picture("tracks_"):
        yield _picture(subject, path.stem.removeprefix("tracks_"), path, recordings)


def _row(subject: Subject, name: str, error: RecordingError) -> tuple[str, ...]:
    of = subject.measurement(name)
    used = "prediction (held out)" if error.holdout else "the fit"
    if of is None:
        return name, used, "", "", ""
    rmse, each = error.number(of.error_key("rmse")), error.numbers(of.error_key(f"{of.channel}s"))
    unit = f" {of.shown.name}" if of.shown.name else ""
    by = [f"{key} {'unseen' if e is None else format(e, of.digits)}" for key, e in each.items()]
    more = f" and {len(by) - MOST_CHANNELS} more" if len(by) > MOST_CHANNELS else ""
    shown = "blew up" if rmse is None else f"{format(rmse, of.digits)}{unit}"
    return name, used, of.quantity, shown, ", ".join(by[:MOST_CHANNELS]) + more


def _picture(subject: Subject, name: str, path: Path, recordings: dict[str, RecordingError]) -> Picture:
    of, error = subject.measurement(name), recordings.get(name)
    quantity = "the measurement" if of is None else of.quantity
    rmse = None if of is None or error is None else error.number(of.error_key("rmse"))
    how_far = "" if rmse is None or of is None else f" The RMSE is {short(rmse)} {of.shown.name}".rstrip() + "."
    held = " The fit did not use this recording." if error is not None and error.holdout else ""
    alt = f"Recording {name}: {quantity}, the data beside the model.{how_far}"
    return Picture(path, alt, f"Recording {name}: data and model.{held}")
