"""Write a run for MLflow, Weights & Biases or TensorBoard, into a folder of this machine; nothing is sent anywhere."""

from __future__ import annotations

import os
import re
import shlex
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from cqrun.errors import MissingExtra, UsageError
from cqrun.jobs.tracking.tracked import Tracked, tracked, when
from cqrun.store.atomic import disk_errors, make_directory

ID = "cqrun.run"
"""Tag with the name of the run, by which it is found again."""

FILES_TOO = "MLFLOW_ALLOW_FILE_STORE"
"""Variable without which MLflow from version 3.7 on takes data bases alone, which need the whole package."""

BATCH = {"metrics": 1000, "params": 100, "tags": 100}
"""Most entries of each sort that MLflow takes at once."""

T = TypeVar("T")


@dataclass(frozen=True)
class Exported:
    """The folder that was written to, and the command that shows it."""

    folder: Path
    show: str


@dataclass(frozen=True)
class Tracker:
    """A program that compares runs.

    Attributes:
        module: the package that writes its files.
        folder: where they are written if nothing else is given.
        write: writes a run into a folder, and returns the command that shows it.
    """

    module: str
    folder: str
    write: Callable[[Any, Tracked, Path], str]


def export_to(tracker: str, run: Path, out: Path | None = None) -> Exported:
    """Write a finished run for a tracker.

    Args:
        tracker: a name in TRACKERS.
        run: the folder of the run.
        out: the folder to write to; the tracker's usual one in the current folder if None.

    Raises:
        UsageError: there is no finished run, or it is in that folder already.
        MissingExtra: the tracker's package is not installed.
    """
    entry = TRACKERS[tracker]
    what, folder = tracked(run), (out or Path(entry.folder)).absolute()
    library = _library(tracker, entry.module)
    make_directory(folder)
    with disk_errors(folder):
        return Exported(folder, entry.write(library, what, folder))


def _library(tracker: str, module: str) -> Any:
    """Return a tracker's package."""
    from importlib import import_module

    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise MissingExtra(
            f"an export to {tracker} needs {error.name}, which is not installed: pip install 'cqrun[{tracker}]'"
        ) from None


def _require_new(there: bool, run: Tracked, folder: Path) -> None:
    if there:
        raise UsageError(f"{folder}: has the run {run.group}/{run.name} already; choose another folder with --out")


# --- MLflow -----------------------------------------------------------------------------------------------------


def _mlflow(mlflow: Any, run: Tracked, folder: Path) -> str:
    """Write a run into a folder of MLflow; an experiment has the runs of one scene."""
    from mlflow.entities import Metric, Param, RunTag

    with _variables(**{"MLFLOW_TRACKING_URI": None, FILES_TOO: "true"}):
        client = mlflow.MlflowClient(tracking_uri=folder.as_uri())
        experiment = client.get_experiment_by_name(run.group)
        number = experiment.experiment_id if experiment else client.create_experiment(run.group)
        _require_new(bool(client.search_runs([number], f"tags.`{ID}` = '{run.name}'")), run, folder)
        milli = lambda seconds: int(1000 * seconds)  # noqa: E731
        made = client.create_run(number, start_time=milli(run.ended - run.seconds), run_name=run.name)
        key = made.info.run_id
        entries: dict[str, list[Any]] = {
            "params": [Param(_key(name), text) for name, text in run.parameters.items()],
            "tags": [RunTag(_key(name), text) for name, text in {**run.tags, ID: run.name}.items()],
            "metrics": [
                Metric(_key(name), number, milli(at), step)
                for step, numbers, at in run.steps()
                for name, number in numbers.items()
            ]
            + [Metric(_key(f"found/{name}"), number, milli(run.ended), 0) for name, number in run.found.items()],
        }
        for sort, all_entries in entries.items():
            for part in _parts(all_entries, BATCH[sort]):
                client.log_batch(key, **{sort: part})
        for name, path in run.files.items():
            client.log_artifact(key, str(path), str(Path(name).parent) if "/" in name else None)
        client.set_terminated(key, "FAILED" if run.tags["status"] == "failed" else "FINISHED", milli(run.ended))
    return f"{FILES_TOO}=true mlflow ui --backend-store-uri {shlex.quote(folder.as_uri())}"


def _key(name: str) -> str:
    """Return a name with no other signs than MLflow takes."""
    return re.sub(r"[^\w\-. /:]", "_", name, flags=re.ASCII)[:250]


def _parts(entries: Sequence[T], size: int) -> Iterator[Sequence[T]]:
    """Yield entries in parts of a size."""
    for k in range(0, len(entries), size):
        yield entries[k : k + size]


# --- Weights & Biases -------------------------------------------------------------------------------------------


def _wandb(wandb: Any, run: Tracked, folder: Path) -> str:
    """Write a run into a folder of Weights & Biases, offline; `wandb sync` would send it."""
    before = set((folder / "wandb").glob("offline-run-*"))
    with _variables(WANDB_MODE="offline", WANDB_SILENT="true", WANDB_CONSOLE="off"):
        made = wandb.init(
            project=run.group, id=run.name, name=run.name, dir=str(folder), mode="offline",
            config={"scene": dict(run.parameters), "run": dict(run.tags)},
            tags=[run.tags.get("job", ""), f"engine {run.tags.get('engine', '')}"],
            settings=wandb.Settings(console="off", silent=True, disable_git=True, disable_code=True),
        )  # fmt: skip
        try:
            for step, numbers, _ in run.steps():
                made.log(numbers, step=step)
            for name, number in run.found.items():
                made.summary[f"found/{name}"] = number
            for name, path in run.files.items():
                copy = Path(made.dir) / name
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, copy)
                made.save(str(copy), base_path=made.dir, policy="now")
        finally:
            made.finish(exit_code=int(run.tags["status"] == "failed"))
    written = sorted(set((folder / "wandb").glob("offline-run-*")) - before)
    return f"wandb sync {shlex.quote(str(written[-1] if written else folder / 'wandb'))}"


# --- TensorBoard ------------------------------------------------------------------------------------------------


def _tensorboard(tensorboard: Any, run: Tracked, folder: Path) -> str:
    """Write a run as event files of TensorBoard, one folder for each run."""
    from tensorboardX.summary import hparams

    place = folder / run.group / run.name
    _require_new(place.is_dir() and any(place.iterdir()), run, folder)
    with tensorboard.SummaryWriter(logdir=str(place), write_to_disk=True) as writer:
        for step, numbers, at in run.steps():
            for name, number in numbers.items():
                writer.add_scalar(name, number, step, walltime=at)
        for name, number in run.found.items():
            writer.add_scalar(f"found/{name}", number, 0, walltime=run.ended)
        for summary in hparams({**run.parameters, **run.tags}, {f"found/{name}": x for name, x in run.found.items()}):
            writer.file_writer.add_summary(summary)
        writer.add_text("scene", _table(run.parameters), 0, walltime=run.ended)
        writer.add_text("run", _table({**run.tags, "ended": when(run.ended), "folder": str(run.run)}), 0)
        for name, path in run.files.items():
            if path.suffix == ".png":
                writer.add_image(name.removesuffix(".png"), _pixels(path), 0, dataformats="HWC", walltime=run.ended)
    return f"tensorboard --logdir {shlex.quote(str(folder))}"


def _table(entries: Any) -> str:
    """Return names and texts as a table in Markdown."""
    rows = (f"| {name} | {text.replace('|', '/')} |" for name, text in entries.items())
    return "\n".join(["| name | value |", "|---|---|", *rows])


def _pixels(path: Path) -> Any:
    """Return the pixels of a picture (height, width, 3) of bytes."""
    import numpy as np
    from PIL import Image

    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB"))


# --- all --------------------------------------------------------------------------------------------------------


@contextmanager
def _variables(**values: str | None) -> Iterator[None]:
    """Set variables of the environment inside the block, or remove them; they would send results elsewhere."""
    before = {name: os.environ.get(name) for name in values}
    try:
        _set(values)
        yield
    finally:
        _set(before)


def _set(values: dict[str, str | None]) -> None:
    for name, text in values.items():
        if text is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = text


TRACKERS = {
    "mlflow": Tracker("mlflow", "mlruns", _mlflow),
    "wandb": Tracker("wandb", ".", _wandb),
    "tensorboard": Tracker("tensorboardX", "tensorboard", _tensorboard),
}
"""The programs, by the name of their extra."""
