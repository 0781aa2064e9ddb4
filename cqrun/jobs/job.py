"""Jobs: commands that make runs of a scene; table.py lists them."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Generic, Protocol, TypeVar, final

from cqrun.build.model import Built
from cqrun.errors import Problem, SceneError, StopAsked, UsageError
from cqrun.running.reporter import Reporter, Silent
from cqrun.running.runs import (
    Source,
    finished_already,
    is_run,
    open_run,
    raise_if_failed,
    refuse_overrides,
    require_extension,
    require_same_data,
    saved_scene,
    scene_of,
)
from cqrun.running.threads import cores
from cqrun.scene.load import dump, resolve
from cqrun.scene.schema import Scene
from cqrun.scene.sections import JobName
from cqrun.store.atomic import write_bytes
from cqrun.store.folder import REPORT
from cqrun.store.result import Result, read_result
from cqrun.store.run import STOPPED, RunDirectory, read_record
from cqrun.store.run_scene import stem_of

NO_FILES: Mapping[str, Path] = MappingProxyType({})

NOT_NAMED = ("history.csv", "activation.csv")
"""Tables of a run that a report does not mention."""


class Prepared(Protocol):
    """A scene that a job has prepared and checked before it runs."""

    @property
    def built(self) -> Built:
        """The scene, with its optimizer."""

    @property
    def threads(self) -> int:
        """Number of threads."""


P = TypeVar("P", bound=Prepared)
R = TypeVar("R", bound=Result)


@dataclass(frozen=True)
class Need:
    """A section that a scene must have.

    Attributes:
        section: its key.
        advice: text for the error message if it is missing.
        instead: another section that may replace it.
    """

    section: str
    advice: str
    instead: str | None = None


@dataclass(frozen=True)
class Job(ABC, Generic[P, R]):
    """A command that makes runs.

    Attributes:
        name: name of the command, in run.json and in a scene's `job`.
        result: the model of its result.
        needs: sections that its scene must have.
        pictures: names of the pictures of its runs (figures/draw.py).
        keeps: by name, the description of files beside the scene of which a run keeps a copy.
        extensible: whether `cqrun resume` can give a finished run more iterations.
    """

    name: JobName
    result: type[R]
    needs: tuple[Need, ...] = ()
    pictures: tuple[str, ...] = ()
    keeps: Mapping[str, str] = field(default_factory=dict)
    extensible: bool = False

    @abstractmethod
    def prepare(self, scene: Scene, threads: int, talk: Reporter, files: Mapping[str, Path] = NO_FILES) -> P:
        """Prepare and check a scene.

        Args:
            files: by name, paths of the files of which the run keeps a copy.

        Raises:
            SceneError, UsageError: the scene cannot be run.
        """

    @abstractmethod
    def reads_data(self, scene: Scene) -> bool:
        """Return whether the job reads the recordings of a scene."""

    @abstractmethod
    def work(self, run: RunDirectory, prepared: P, talk: Reporter, /) -> None:
        """Start or continue the job in a run directory; it ends with `run.finish`.

        Raises:
            StopAsked, Stopped: asked to stop. RunError: the run failed in a way that its status cannot describe.
        """

    @abstractmethod
    def lines(self, run: Path, result: R) -> Iterator[str]:
        """Yield the result of a run as lines for a terminal."""

    @final
    def run(
        self, source: Path | str, overrides: Sequence[str], out: Path | str, *, fresh: bool = False,
        threads: int | None = None, reporter: Reporter | None = None,
    ) -> Path:  # fmt: skip
        """Start or continue the job for a scene file; return the run's directory.

        Args:
            source: the scene file, or a run, as `read`.
            overrides: list of `key.path=value`.
            out: directory of all results.
            fresh: delete an existing run and start again.
            threads: largest number of threads; all cores if not given.
            reporter: receives the progress, and has the flag to stop.

        Raises:
            SceneError, UsageError: bad input. RunError: the run failed. Stopped: it can be resumed.
        """
        given = self.read(Path(source), overrides, reporter or Silent())
        return raise_if_failed(
            self.start(given.stem, given.scene, out, files=given.files, fresh=fresh, threads=threads, reporter=reporter)
        )

    def read(self, source: Path, overrides: Sequence[str], talk: Reporter) -> Source:
        """Return what the command runs: the scene of a file, or of a run of the same command.

        Raises:
            SceneError, UsageError: the scene is wrong, or the run is of another command.
        """
        if is_run(source) and (job := read_record(source).get("job")) != self.name:
            raise UsageError(
                f"{source}: is a run of {job}; `cqrun {self.name}` takes a scene, or a run of {self.name}, whose scene "
                "it runs: give the file of the scene"
            )
        return Source(stem_of(source), scene_of(source, overrides))

    @final
    def start(
        self, stem: str, scene: Scene, out: Path | str, *, files: Mapping[str, Path] = NO_FILES, fresh: bool = False,
        threads: int | None = None, reporter: Reporter | None = None,
    ) -> Path:  # fmt: skip
        """Start or continue the job for a loaded scene; return the run's directory, even if the run failed.

        Args:
            stem: name of the scene, and of the folder of its runs.
            files: by name, paths of the files of which the run keeps a copy.

        The other arguments and errors are those of `run`.
        """
        talk, n_threads = reporter or Silent(), cores(threads)
        prepared = self.prepare(scene, n_threads, talk, files)
        scene = prepared.built.scene
        with open_run(
            stem, scene, Path(out), job=self.name, threads=n_threads, fresh=fresh, with_data=self.reads_data(scene),
            files=files,
        ) as run:  # fmt: skip
            if run.warning:
                talk.warn(run.warning)
            if finished_already(run, talk):
                return run.path
            if run.record.get("extended"):
                prepared = self.prepare(saved_scene(run), n_threads, talk, files)
            for name, file in files.items():
                write_bytes(run.path / name, file.read_bytes())
            self._work(run, prepared, talk)
            return run.path

    @final
    def resume(self, run: RunDirectory, overrides: Sequence[str], threads: int, talk: Reporter) -> Path:
        """Continue a run in its directory, and return the directory.

        Args:
            overrides: the optimizer's number of iterations only, if the job can be extended.

        Raises:
            UsageError: wrong overrides, or a file has changed. RunError: the run failed. Stopped: asked to stop.
        """
        if self.extensible:
            require_extension(run, overrides)
        else:
            refuse_overrides(run, overrides)
        scene = saved_scene(run, overrides)
        if self.reads_data(scene):
            require_same_data(run)
        if overrides or not finished_already(run, talk, asked_by_scene=False):
            prepared = self.prepare(scene, threads, talk, self._kept(run))
            if overrides:
                run.extend(dump(resolve(prepared.built.scene)), list(overrides))
            self._work(run, prepared, talk)
        return raise_if_failed(run.path)

    def _work(self, run: RunDirectory, prepared: P, talk: Reporter) -> None:
        """Do the job; a request to stop is heard between two rollouts.

        Raises:
            Stopped: asked to stop. RunError: as `work`.
        """
        if prepared.built.warnings:  # for its page: they were said before it began
            run.add_facts(warnings=[str(replace(w, where=w.where.rpartition("/")[2])) for w in prepared.built.warnings])
        with talk.stop.deferred():
            try:
                self.work(run, prepared, talk)
            except StopAsked:
                reason = "stopped before its results were written"
                run.finish(STOPPED, talk.stop.named(reason))
                raise talk.stop.stopped(f"{reason}; `cqrun resume {run.path}` {self.again}") from None

    @property
    def again(self) -> str:
        """What `cqrun resume` does with a run that was stopped."""
        return "continues" if self.extensible else "starts it again"

    @final
    def report(self, run: Path) -> list[str]:
        """Return the result of a run as lines for a terminal, or its status if it has no result yet.

        Raises:
            UsageError: there is no run, or its result cannot be read.
        """
        record, result = read_record(run), read_result(run)
        if result is None:
            return [f"{self.name}: {record['status']}" + (f" ({record['reason']})" if record.get("reason") else "")]
        if not isinstance(result, self.result):
            raise UsageError(f"{run}: is a run of {self.name}, but its result is one of {result.job}")
        tables = [file for file in sorted(run.glob("*.csv")) if file.name not in NOT_NAMED]
        files = [*run.glob(REPORT), *sorted((run / "figures").glob("*.png")), *tables, *run.glob("trajectory.h5")]
        names = ", ".join(str(file.relative_to(run)) for file in files)
        return [*self.lines(run, result), *(["", f"see {names}"] if files else [])]

    @final
    def require_sections(self, scene: Scene) -> None:
        """Raise SceneError with advice for each missing section."""
        missing = [n for n in self.needs if not getattr(scene, n.section)]
        missing = [n for n in missing if n.instead is None or not getattr(scene, n.instead)]
        if missing:
            raise SceneError(
                [Problem(scene.where(n.section), n.section, f"{self.name} needs it: {n.advice}") for n in missing]
            )

    def _kept(self, run: RunDirectory) -> dict[str, Path]:
        """Return the run's copies of its files; raise UsageError if one has changed."""
        copies = {}
        for name, what in self.keeps.items():
            began_with, file = run.record["files"].get(name), run.path / name
            if began_with is None:
                continue
            if not file.is_file() or hashlib.sha256(file.read_bytes()).hexdigest() != began_with:
                raise UsageError(f"{file}: this copy of {what} is not what the run began with; run the scene again")
            copies[name] = file
        return copies
