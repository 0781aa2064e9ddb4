"""What is published of a figure at one size: a CSV, a PNG, a PDF, and a JSON record with the verdict."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, Field, ValidationError

from benchmarks.papers.figure import Figure, Folders, Judgement, Size, Table, Verdict, read_table, write_table
from benchmarks.papers.machinery.task import Task, TaskError, digest
from cqrun.figures.style import save, styled
from cqrun.store.atomic import make_directory, write_json

T = TypeVar("T")


class TaskRecord(BaseModel):
    """A task behind a published figure; command and fingerprint say which task it was."""

    command: str
    fingerprint: str
    minutes: float
    remark: str | None = None


class Record(BaseModel):
    """What is known of a published figure."""

    verdict: Judgement = Judgement.UNFINISHED
    checks: dict[str, bool] = {}
    asked: str = ""  # by the verdict
    data: str = ""  # a hash of the CSV
    done: tuple[int, int]  # how many tasks are done, and how many there are
    failed: list[str]  # why runs failed
    tasks: dict[str, TaskRecord] = Field(alias="works")
    engine: list[str]  # hashes of the engines that did the tasks
    machines: list[dict[str, Any]]


@dataclass(frozen=True)
class Publication:
    """A figure at one size, and its files below `out` (results/figures)."""

    figure: Figure
    size: Size
    out: Path

    def file(self, suffix: str) -> Path:
        """Return the path of one of its files."""
        return self.out / self.size / f"{self.figure.id}{suffix}"

    def record(self) -> Record | None:
        """Return the record, or None if nothing is published.

        Raises:
            TaskError: the record is damaged.
        """
        file = self.file(".json")
        try:
            return Record.model_validate_json(file.read_bytes()) if file.exists() else None
        except ValidationError as error:
            first = error.errors()[0]
            raise self._damaged(file, ": ".join(["damaged", *map(str, first["loc"]), first["msg"]])) from None

    def require_data(self, record: Record) -> None:
        """Raise a TaskError if the CSV is not the one that a record belongs to."""
        file = self.file(".csv")
        if not file.exists() or digest(file.read_bytes()) != record.data:
            raise self._damaged(file, "not the numbers that were published")

    def verified(self) -> tuple[Record, bytes] | None:
        """Return the record and the PNG, or None; raise a TaskError if one of them or the CSV is damaged."""
        record, picture = self.record(), self.file(".png")
        if record is None:
            return None
        self.require_data(record)
        if not picture.exists():
            raise self._damaged(picture, "missing")
        return record, picture.read_bytes()

    def _damaged(self, file: Path, problem: str) -> TaskError:
        return TaskError(f"{file}: {problem}; restore it from git, or run `{self.figure.command(self.size)}`")

    def is_current(self, record: Record) -> bool:
        """Return whether a record is of the tasks as they are today."""
        published = {name: (task.command, task.fingerprint) for name, task in record.tasks.items()}
        return published == {task.name: (task.command, task.fingerprint()) for task in self.figure.tasks(self.size)}

    def is_complete(self, record: Record | None) -> bool:
        """Return whether a record is of all tasks, as they are today."""
        return record is not None and record.done[0] >= record.done[1] and self.is_current(record)

    def verdict(self, table: Table, record: Record) -> Verdict:
        """Return the verdict on a table.

        A figure is unfinished if a task is not done, or has changed since. It is reproduced in part at best if runs
        failed.
        """
        complete = self.is_complete(record)
        verdict = attempt(complete, self.figure.judge, table, self.size)
        if record.failed:
            first = record.failed[0].partition(";")[0]
            verdict = verdict or Verdict.of({})
            verdict = verdict.also({f"no run fails ({len(record.failed)} failed: {first})": False})
        if complete and verdict is not None:
            return verdict
        return Verdict(Judgement.UNFINISHED, verdict.checks if verdict is not None else {})

    def publish(self, runs: Path) -> Verdict | None:
        """Publish what the tasks have found so far; return the verdict, or None if there is nothing yet.

        Args:
            runs: holds the folders of all tasks of this size.
        """
        tasks = {task: runs / task.name for task in self.figure.tasks(self.size)}
        folders = begun_folders(list(tasks), runs)
        done = {task: facts for task, folder in tasks.items() if (facts := task.done(folder)) is not None}
        complete = len(done) == len(tasks)
        table = attempt(complete, self.figure.table, folders, self.size) if folders else None
        if not table or not len(next(iter(table.values()))):
            return None
        make_directory(self.out / self.size)
        write_table(table, self.file(".csv"))
        record = Record(
            done=(len(done), len(tasks)),
            failed=[reason for task in done for reason in task.failures(tasks[task])],
            works={
                task.name: TaskRecord(
                    command=task.command,
                    fingerprint=task.fingerprint(),
                    minutes=task.spent(folder) / 60.0,
                    remark=task.remark(folder) or None,
                )
                for task, folder in tasks.items()
            },
            engine=sorted({task.engine(folder) for task, folder in tasks.items() if task.name in folders}),
            machines=[facts["machine"] for facts in done.values()],
        )
        return self._draw_and_judge(record, folders, complete)

    def judge_again(self) -> Verdict | None:
        """Draw and judge the published table again; return the verdict, or None if nothing is published.

        Raises:
            TaskError: the CSV or the record is damaged.
        """
        record = self.record()
        if record is None:
            return None
        self.require_data(record)
        return self._draw_and_judge(record, None, True)

    def _draw_and_judge(self, record: Record, folders: Folders | None, complete: bool) -> Verdict | None:
        """Draw and judge the CSV, and write the record; return the verdict, or None if it cannot be drawn yet.

        Without the folders of runs, only figures that do not need them are drawn.
        """
        table = read_table(self.file(".csv"))
        if folders is not None or not self.figure.needs_runs:
            with styled(formulas=True):
                picture = attempt(complete, self.figure.draw, table, self.size, folders or {})
                if picture is None:
                    return None
                save(picture, self.file(""), ("png", "pdf"))
        verdict = self.verdict(table, record)
        record.verdict, record.checks = verdict.judgement, dict(verdict.checks)
        record.asked, record.data = self.figure.criteria[self.size], digest(self.file(".csv").read_bytes())
        write_json(self.file(".json"), record.model_dump(mode="json", by_alias=True, exclude_none=True))
        return verdict


def begun_folders(tasks: Sequence[Task], runs: Path) -> Folders:
    """Return the folders of tasks that have begun."""
    return {task.name: runs / task.name for task in tasks if task.begun(runs / task.name)}


def attempt(complete: bool, make: Callable[..., T], *args: Any) -> T | None:
    """Return what a figure's method makes of its tasks; None if they are not complete, and that is too little."""
    try:
        return make(*args)
    except (ValueError, LookupError, TypeError, StopIteration, FileNotFoundError):
        if complete:
            raise
        return None
