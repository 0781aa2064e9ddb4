"""What a command that makes runs does with a scene; table.py lists them all."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Generic, Protocol, TypeVar, final

from cqrun.build.model import Built
from cqrun.errors import Problem, SceneError, UsageError
from cqrun.running.reporter import Reporter, Silent
from cqrun.running.runs import (
    finished_already,
    open_run,
    raise_if_failed,
    refuse_overrides,
    require_extension,
    require_same_data,
    saved_scene,
)
from cqrun.running.threads import cores
from cqrun.scene.load import dump, load_scene, resolve
from cqrun.scene.schema import Scene
from cqrun.scene.sections import JobName
from cqrun.store.atomic import write_bytes
from cqrun.store.result import Result, read_result
from cqrun.store.run import RunDirectory, read_record, stem_of

NO_FILES: Mapping[str, Path] = MappingProxyType({})

NOT_NAMED = ("history.csv", "activation.csv")
"""Tables of a run that a report does not name."""


class Prepared(Protocol):
    """What a job makes of a scene before it runs: all that can be refused has been."""

    @property
    def built(self) -> Built:
        """The scene, ready to run; its optimizer is chosen."""

    @property
    def threads(self) -> int:
        """How many to use."""


P = TypeVar("P", bound=Prepared)
R = TypeVar("R", bound=Result)


@dataclass(frozen=True)
class Need:
    """A section that a scene must have.

    Attributes:
        section: its key.
        advice: what to say where it is missing.
        instead: another section that stands in for it.
    """

    section: str
    advice: str
    instead: str | None = None


@dataclass(frozen=True)
class Job(ABC, Generic[P, R]):
    """A command that makes runs.

    Attributes:
        name: of the command, as run.json and a scene's `job` have it.
        result: the model of what it finds.
        needs: sections that its scene must have.
        pictures: names of the pictures that are drawn of its runs (figures/draw.py).
        keeps: files beside the scene of which a run keeps a copy, by name: what each is.
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
        """Return what a scene is run with.

        Args:
            files: of those that the job keeps, where each is to be read.

        Raises:
            SceneError, UsageError: everything that a run is refused for.
        """

    @abstractmethod
    def reads_data(self, scene: Scene) -> bool:
        """Say whether the job reads the recordings that a scene names."""

    @abstractmethod
    def work(self, run: RunDirectory, prepared: P, talk: Reporter, /) -> None:
        """Do the job in a run directory, from where it stands; it ends with `run.finish`.

        Raises:
            Stopped: asked to stop. RunError: the run failed, and cannot say how by its status.
        """

    @abstractmethod
    def lines(self, run: Path, result: R) -> Iterator[str]:
        """Yield what a run found, as lines for a terminal."""

    @final
    def run(
        self,
        source: Path | str,
        overrides: Sequence[str],
        out: Path | str,
        *,
        fresh: bool = False,
        threads: int | None = None,
        reporter: Reporter | None = None,
    ) -> Path:
        """Run the job of a scene file, or go on with it; return the run's directory.

        Args:
            source: the scene file.
            overrides: `key.path=value` each.
            out: directory of all results.
            fresh: throw away what there is and start over.
            threads: how many to use at most; all cores if not given.
            reporter: told of progress and asked whether to stop.

        Raises:
            SceneError, UsageError: bad input. RunError: the run failed. Stopped: it can be resumed.
        """
        source = Path(source)
        scene = load_scene(source, overrides)
        return raise_if_failed(self.start(stem_of(source), scene, out, fresh=fresh, threads=threads, reporter=reporter))

    @final
    def start(
        self,
        stem: str,
        scene: Scene,
        out: Path | str,
        *,
        files: Mapping[str, Path] = NO_FILES,
        fresh: bool = False,
        threads: int | None = None,
        reporter: Reporter | None = None,
    ) -> Path:
        """Run the job of a scene that is loaded, or go on with it; return the run's directory, also where it failed.

        Args:
            stem: name of the scene, and of the folder of its runs.
            files: of those that the job keeps, where each is to be read.

        The other arguments and errors are those of `run`.
        """
        talk, n_threads = reporter or Silent(), cores(threads)
        prepared = self.prepare(scene, n_threads, talk, files)
        scene = prepared.built.scene
        with open_run(
            stem, scene, Path(out), job=self.name, threads=n_threads, fresh=fresh, with_data=self.reads_data(scene),
            files=files,
        ) as run:  # fmt: skip
            if finished_already(run, talk):
                return run.path
            if run.record.get("extended"):
                prepared = self.prepare(saved_scene(run), n_threads, talk, files)
            for name, file in files.items():
                write_bytes(run.path / name, file.read_bytes())
            self.work(run, prepared, talk)
            return run.path

    @final
    def resume(self, run: RunDirectory, overrides: Sequence[str], threads: int, talk: Reporter) -> Path:
        """Go on with a run from its directory; return that.

        Args:
            overrides: of the optimizer's iterations alone, where the job can be extended.

        Raises:
            UsageError: the overrides, or files that have changed since. RunError: the run failed. Stopped: asked to.
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
            self.work(run, prepared, talk)
        return raise_if_failed(run.path)

    @final
    def report(self, run: Path) -> list[str]:
        """Return what a run found, as lines for a terminal; of one that has found nothing yet, its status.

        Raises:
            UsageError: it is no run, or what it found cannot be read.
        """
        record, result = read_record(run), read_result(run)
        if result is None:
            return [f"{self.name}: {record['status']}" + (f" ({record['reason']})" if record.get("reason") else "")]
        if not isinstance(result, self.result):
            raise UsageError(f"{run}: its result is one of {result.job}, and the run one of {self.name}")
        tables = [file for file in sorted(run.glob("*.csv")) if file.name not in NOT_NAMED]
        files = [*sorted((run / "figures").glob("*.png")), *tables, *run.glob("trajectory.h5")]
        names = ", ".join(str(file.relative_to(run)) for file in files)
        return [*self.lines(run, result), *(["", f"see {names}"] if files else [])]

    @final
    def require_sections(self, scene: Scene) -> None:
        """Refuse a scene that lacks sections; SceneError with advice for each."""
        missing = [n for n in self.needs if not getattr(scene, n.section)]
        missing = [n for n in missing if n.instead is None or not getattr(scene, n.instead)]
        if missing:
            raise SceneError(
                [Problem(scene.where(n.section), n.section, f"{self.name} needs it: {n.advice}") for n in missing]
            )

    def _kept(self, run: RunDirectory) -> dict[str, Path]:
        """Return the run's copies of the files that it began with; UsageError where one has changed."""
        found = {}
        for name, what in self.keeps.items():
            began_with, file = run.record["files"].get(name), run.path / name
            if began_with is None:
                continue
            if not file.is_file() or hashlib.sha256(file.read_bytes()).hexdigest() != began_with:
                raise UsageError(f"{file}: this copy of {what} is not what the run began with; run the scene again")
            found[name] = file
        return found
