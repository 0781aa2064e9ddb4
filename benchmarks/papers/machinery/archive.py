"""Archives of unfinished tasks, to be committed, so that another machine can continue them.

An archive lies in results/figures/SIZE/unfinished until its figure is complete. It holds the task's folder without
trajectories and pictures: about 100 kB for each unfinished run, whose optimizer's state is in it, and less for a
finished one. Paths of this machine are stored as names, and replaced by those of the other machine.
"""

from __future__ import annotations

import io
import json
import lzma
import tarfile
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.papers.machinery.runs import SCENES
from benchmarks.papers.machinery.task import CLOCK, DONE, TOO_LONG_TO_LOSE, Task, TaskError, require_short
from cqrun.fingerprint import engine_hash
from cqrun.store.atomic import make_directory, write_bytes
from cqrun.store.run import FINISHED, read_record

TEXT = (".json", ".yaml", ".csv")
RUNS_NAME, SCENES_NAME = "@RUNS@", "@SCENES@"
"""Names in an archive of the folder of all runs, and of the folder of all scenes."""

STATE = (".npz", ".npy", ".log")
"""What a run continues from, and controllers and designs. Figures do not need them of a finished run."""

LONGEST_LIST = 100
"""Longer lists among the unknowns of a finished run, one number a particle, are not packed. Only CQ1 Fig 5 shows such a
list, on moving bodies, and trajectories are not packed either."""


def archive_path(task: Task, folder: Path) -> Path:
    """Return where the archive of a task is, below the folder of a size's figures."""
    return folder / "unfinished" / f"{task.name}.tar.xz"


def pack(task: Task, runs: Path, archive: Path) -> None:
    """Pack what there is of a task, if it has begun.

    An archive that holds more of the same task, from another machine or engine, stays. An archive of the task as it
    was before it changed is set aside if it took long.
    """
    root = runs / task.name
    if not task.begun(root) or (archive.exists() and not _makes_way(archive, task, root)):
        return
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w:xz") as tar:
        for path in _files_to_pack(root):
            data = _data_to_pack(path, runs)
            member = tarfile.TarInfo(path.relative_to(root).as_posix())
            member.size = len(data)
            tar.addfile(member, io.BytesIO(data))
    make_directory(archive.parent)
    write_bytes(archive, packed.getvalue())


def _makes_way(archive: Path, task: Task, root: Path) -> bool:
    """Return whether an archive may be replaced; set it aside if it is of another task and took long."""
    clock, is_done = _contents(archive)
    if clock["fingerprint"] == task.fingerprint():
        if (is_done, clock["seconds"]) <= (task.done(root) is not None, task.spent(root)):
            return True
        print(f"    {archive} stays: it holds more of {task.name} than {root}", flush=True)
        return False
    if clock["seconds"] > TOO_LONG_TO_LOSE:
        aside = archive.with_name(f"{task.name}.was-{clock['fingerprint']}-{clock['engine']}.tar.xz")
        print(f"    {task.name} has changed: its earlier archive is now {aside}", flush=True)
        archive.replace(aside)
    return True


def _files_to_pack(root: Path) -> Iterator[Path]:
    for path in sorted(root.rglob("*")):
        if path.suffix in TEXT or (path.suffix in STATE and not _is_finished(path.parent)):
            yield path


def _data_to_pack(path: Path, runs: Path) -> bytes:
    """Return the content of a file, without paths and without long lists."""
    data = path.read_bytes()
    if path.name == "run.json":
        record = json.loads(data)
        record["argv"] = ["cqrun", record["job"]]
        record["base"] = SCENES_NAME + str(record.get("base", "")).rpartition("scenes")[2]
        data = json.dumps(record, indent=2).encode()
    if path.name == "result.json" and _is_finished(path.parent):
        result = json.loads(data)
        for name, entry in result.get("unknowns", {}).items():
            short = {k: v for k, v in entry.items() if not (isinstance(v, list) and len(v) > LONGEST_LIST)}
            result["unknowns"][name] = short
        data = json.dumps(result, indent=2).encode()
    return data.replace(str(runs.resolve()).encode(), RUNS_NAME.encode()) if path.suffix in TEXT else data


def _is_finished(run: Path) -> bool:
    return (run / "run.json").exists() and read_record(run)["status"] in FINISHED


def _contents(archive: Path) -> tuple[dict[str, Any], bool]:
    """Return the clock in an archive, and whether its task is done."""
    try:
        with tarfile.open(archive) as tar:
            return json.loads(tar.extractfile(CLOCK).read()), DONE in tar.getnames()  # type: ignore[union-attr]
    except (tarfile.TarError, lzma.LZMAError, EOFError, KeyError, ValueError) as error:
        raise TaskError(f"{archive}: damaged ({error}); restore it from git, or delete it to start over") from None


def unpack(task: Task, runs: Path, archive: Path) -> bool:
    """Unpack the archive of a task that has no folder here; return whether it was unpacked.

    What another engine has finished is unpacked. What it has only begun is not, because this engine cannot continue it.

    Raises:
        TaskError: another engine has worked long on it, or the archive is damaged.
    """
    root = runs / task.name
    if root.exists() or not archive.exists():
        return False
    clock, is_done = _contents(archive)
    if clock["fingerprint"] != task.fingerprint():
        if clock["seconds"] > TOO_LONG_TO_LOSE:
            print(f"    {archive} is not used: {task.name} has changed since", flush=True)
        return False
    if clock["engine"] != engine_hash() and not is_done:
        require_short(archive, clock)
        return False
    make_directory(runs)
    with tarfile.open(archive) as tar, tempfile.TemporaryDirectory(dir=runs) as name:
        fresh = Path(name) / task.name
        tar.extractall(fresh, filter="data")
        for path in fresh.rglob("*"):
            if path.suffix in TEXT:
                data = path.read_bytes().replace(RUNS_NAME.encode(), str(runs.resolve()).encode())
                path.write_bytes(data.replace(SCENES_NAME.encode(), str(SCENES).encode()))
        fresh.rename(root)
    return True
