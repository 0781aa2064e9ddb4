"""What long work needs to go on elsewhere: its folder without trajectories and pictures, packed, to be committed.

A work's archive lies in results/figures/SIZE/unfinished while its figure is not complete: some hundred kB for a run
that is not finished (its optimizer's state), a hundred at most for one that is (its history and result). Paths of
this machine are packed as names and unpacked as the paths of the other.
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

from benchmarks.papers.machinery.work import CLOCK, DONE, SCENES, WORTH, Work, WorkError, check_worth
from cqrun.fingerprint import engine_hash
from cqrun.store.atomic import make_directory, write_bytes
from cqrun.store.run import FINISHED, read_record

TEXT = (".json", ".yaml", ".csv")
RUNS, SCENES_HERE = "@RUNS@", "@SCENES@"
"""What the folder of all runs, and that of the scenes, are called in an archive."""

STATES = (".npz", ".npy", ".log")
"""What a run goes on from (evals.*), and controllers and designs: no figure asks a finished run for them."""

MOST_NUMBERS = 100
"""A longer list among the unknowns of a finished run, one for every particle, is not packed: figures show one only on
bodies in motion (CQ1 Fig 5), and trajectories are not packed either."""


def archive_of(work: Work, folder: Path) -> Path:
    """Return where a work's archive is, in the folder of a size's figures."""
    return folder / "unfinished" / f"{work.name}.tar.xz"


def keep(work: Work, runs: Path, archive: Path) -> None:
    """Pack what was begun, if anything was, and not before the work changed.

    An archive of the same work that holds more of it, from another machine or engine, stays. One of what the work was
    before it changed is put aside if it took long.
    """
    root = runs / work.name
    if not work.begun(root):
        return
    if archive.exists():
        there, is_done = _contents(archive)
        mine = work.done(root) is not None, work.spent(root)
        if there["fingerprint"] == work.fingerprint() and (is_done, there["seconds"]) > mine:
            print(f"    {archive} holds more of {work.name} than {root}, and stays", flush=True)
            return
        if there["fingerprint"] != work.fingerprint() and there["seconds"] > WORTH:
            aside = archive.with_name(f"{work.name}.was-{there['fingerprint']}-{there['engine']}.tar.xz")
            print(f"    {work.name} has changed: what it was is put aside in {aside}", flush=True)
            archive.replace(aside)
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w:xz") as tar:
        for path in _small(root):
            data = path.read_bytes()
            if path.name == "run.json":
                data = _without_places(data)
            if path.name == "result.json" and _is_finished(path.parent):
                data = _without_fields(data)
            if path.suffix in TEXT:
                data = _renamed(data, {str(runs.resolve()): RUNS})
            member = tarfile.TarInfo(path.relative_to(root).as_posix())
            member.size = len(data)
            tar.addfile(member, io.BytesIO(data))
    make_directory(archive.parent)
    write_bytes(archive, packed.getvalue())


def _small(root: Path) -> Iterator[Path]:
    for path in sorted(root.rglob("*")):
        if path.suffix in TEXT or (path.suffix in STATES and not _is_finished(path.parent)):
            yield path


def _without_places(record: bytes) -> bytes:
    """Return a run's record without the paths of who ran it."""
    facts = json.loads(record)
    facts["argv"] = ["cqrun", facts["job"]]
    facts["base"] = SCENES_HERE + str(facts.get("base", "")).rpartition("scenes")[2]
    return json.dumps(facts, indent=2).encode()


def _without_fields(result: bytes) -> bytes:
    """Return a run's result without what was found for every particle."""
    facts = json.loads(result)
    for name, entry in facts.get("unknowns", {}).items():
        short = {
            key: value for key, value in entry.items() if not (isinstance(value, list) and len(value) > MOST_NUMBERS)
        }
        facts["unknowns"][name] = short
    return json.dumps(facts, indent=2).encode()


def _is_finished(run: Path) -> bool:
    return (run / "run.json").exists() and read_record(run)["status"] in FINISHED


def _renamed(data: bytes, names: dict[str, str]) -> bytes:
    for old, new in names.items():
        data = data.replace(old.encode(), new.encode())
    return data


def _contents(archive: Path) -> tuple[dict[str, Any], bool]:
    """Return the clock in an archive, and whether its work is done."""
    try:
        with tarfile.open(archive) as tar:
            return json.loads(tar.extractfile(CLOCK).read()), DONE in tar.getnames()  # type: ignore[union-attr]
    except (tarfile.TarError, lzma.LZMAError, EOFError, KeyError, ValueError) as error:
        raise WorkError(f"{archive}: cannot be read ({error}); get it once more, or delete it to start over") from None


def restore(work: Work, runs: Path, archive: Path) -> bool:
    """Unpack a work that was begun elsewhere, if it is not here; say whether it was.

    What another engine has begun is not taken, as this one could not go on with it; what it has finished is.

    Raises:
        WorkError: another engine has begun it and spent long on it, or the archive cannot be read.
    """
    root = runs / work.name
    if root.exists() or not archive.exists():
        return False
    clock, is_done = _contents(archive)
    if clock["fingerprint"] != work.fingerprint():
        if clock["seconds"] > WORTH:
            print(f"    {archive} is of what {work.name} was before it changed, and is not taken up", flush=True)
        return False
    if clock["engine"] != engine_hash() and not is_done:
        check_worth(archive, clock)
        return False
    make_directory(runs)
    with tarfile.open(archive) as tar, tempfile.TemporaryDirectory(dir=runs) as name:
        fresh = Path(name) / work.name
        tar.extractall(fresh, filter="data")
        for path in fresh.rglob("*"):
            if path.suffix in TEXT:
                names = {RUNS: str(runs.resolve()), SCENES_HERE: str(SCENES)}
                path.write_bytes(_renamed(path.read_bytes(), names))
        fresh.rename(root)
    return True
