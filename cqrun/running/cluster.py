"""Several runs on a Dask cluster, in place of processes of this machine (`fleet.py`).

Each run is a task: a worker starts the same process as `fleet.py` does. If the workers see the files of this machine (a
shared file system), runs stay where they are, and when a worker dies, another one continues its run. If not, the scene
and the files that it names travel to the worker, and the directory of the run comes back when it has ended.
"""

from __future__ import annotations

import io
import json
import signal
import subprocess
import sys
import tarfile
import tempfile
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cqrun.errors import MissingExtra, UsageError
from cqrun.fingerprint import engine_hash
from cqrun.running.fleet import GOES_ON, Member, reason_in, report_progress
from cqrun.running.reporter import Reporter
from cqrun.store.atomic import write_json, write_text
from cqrun.store.folder import RECORD, make_below
from cqrun.store.lock import is_locked

POLL_INTERVAL = 0.5
"""Time between two looks at tasks, processes and locks [s]."""

DEATHS = 5
"""Workers that may die with a run before it counts as failed, on a cluster that is made here."""

UNSEEN = (
    "a worker does not see the files of this machine, and the scene is that of a run, or names files elsewhere: give "
    "the scene's file, with what it names below its folder, or use a shared file system"
)

PROCESSES = "processes"
"""The place of runs on this machine."""


@dataclass(frozen=True)
class Parcel:
    """What a worker needs that does not see the files of this machine.

    Attributes:
        scene: name of the scene file.
        files: contents of the scene and of the files that it names, by their paths from the scene's folder.
    """

    scene: str
    files: Mapping[str, bytes]


@dataclass(frozen=True)
class Order:
    """A run that a worker makes.

    Attributes:
        words: the words of the command after the interpreter, up to the scene.
        options: the words after the scene.
        source, out: the scene file and the directory of all results on this machine.
        run: directory of the run.
        token: a file that only this sweep has written, and `secret` its content: who can read it shares the files.
        stop: name of the event that asks for an early end.
        engine: hash of the engine.
    """

    words: tuple[str, ...]
    options: tuple[str, ...]
    source: str
    out: str
    run: str
    token: str
    secret: str
    stop: str
    engine: str
    parcel: Parcel | None = None


@dataclass(frozen=True)
class Outcome:
    """How a run ended: the exit code, its last message, and its directory as an archive if it comes back."""

    code: int
    message: str
    archive: bytes = b""


# --- on a worker ------------------------------------------------------------------------------------------------------


def carry_out(order: Order) -> Outcome:
    """Make a run on a worker."""
    if engine_hash() != order.engine:
        return Outcome(2, f"a worker has another engine ({engine_hash()} in place of {order.engine}): install the same")
    token = Path(order.token)
    if token.is_file() and token.read_text(encoding="utf-8") == order.secret:
        while is_locked(Path(order.run)):
            time.sleep(POLL_INTERVAL)
        return _process(order, order.source, order.out)
    if order.parcel is None:
        return Outcome(2, UNSEEN)
    with tempfile.TemporaryDirectory(prefix="cqrun-") as name:
        here, out = Path(name) / "scene", Path(name) / "out"
        for path, content in order.parcel.files.items():
            (here / path).parent.mkdir(parents=True, exist_ok=True)
            (here / path).write_bytes(content)
        found = _process(order, str(here / order.parcel.scene), str(out))
        run = out / Path(order.run).relative_to(order.out)
        return Outcome(found.code, found.message.replace(str(run), order.run), _packed(run) if run.is_dir() else b"")


def _process(order: Order, source: str, out: str) -> Outcome:
    """Run the command; pass a request to stop on to it."""
    from distributed import Event

    stop = Event(order.stop)
    command = [sys.executable, *order.words, source, "--out", out, *order.options]
    bound = [sys.executable, "-P", "-m", "cqrun.running.bound", *command]
    with tempfile.TemporaryFile() as errors:
        with subprocess.Popen(bound, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=errors) as process:
            while process.poll() is None:
                if stop.is_set():
                    process.send_signal(signal.SIGTERM)
                    process.wait()
                time.sleep(POLL_INTERVAL)
        errors.seek(0)
        lines = errors.read().decode(errors="replace").strip().splitlines()
    return Outcome(process.returncode, lines[-1] if lines else "")


def _packed(run: Path) -> bytes:
    """Return a directory as an archive."""
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w:gz", compresslevel=1) as archive:
        archive.add(run, arcname=".")
    return out.getvalue()


# --- on this machine --------------------------------------------------------------------------------------------------


@dataclass
class _Task:
    member: Member
    future: Any = field(repr=False)


def require_place(place: str) -> None:
    """Raise UsageError if there is no such place for runs."""
    if place not in (PROCESSES, "dask", "slurm") and not place.startswith("dask://"):
        raise UsageError(f"--on {place}: no such place; there are {PROCESSES}, dask, dask://HOST:PORT and slurm")


def run_on_cluster(
    members: Sequence[Member], place: str, at_once: int, what: str, reporter: Reporter, *, source: Path, out: Path,
    parcel: Parcel | None,
) -> None:  # fmt: skip
    """Make the run of every member on a cluster; arguments as `run_fleet`.

    Args:
        place: `dask://HOST:PORT`, `dask` for a cluster of `at_once` workers on this machine, or `slurm`.
        source, out: scene file and directory of all results, which the commands of the members name.
        parcel: what workers need that do not see them; None if it cannot travel.

    Raises:
        UsageError: there is no such place. MissingExtra: its library is not installed.
    """
    token = out / f".sweep-{uuid.uuid4().hex}"
    secret, stop = uuid.uuid4().hex, f"stop-{uuid.uuid4().hex}"
    write_text(token, secret)
    try:
        with reporter.stop.deferred(), _client(place, at_once) as client:
            orders = [_order(m, source, out, token, secret, stop, parcel) for m in members]
            pairs = zip(members, orders, strict=True)
            tasks = [_Task(member, client.submit(carry_out, order, pure=False)) for member, order in pairs]
            _wait(tasks, client, stop, what, reporter, source)
    finally:
        token.unlink(missing_ok=True)


def _order(
    member: Member, source: Path, out: Path, token: Path, secret: str, stop: str, parcel: Parcel | None
) -> Order:
    words = list(member.command)
    begin, place = words.index(str(source)), words.index("--out")
    options = [word for k, word in enumerate(words) if k > begin and k not in (place, place + 1)]
    return Order(
        tuple(words[1:begin]), tuple(options), str(source.resolve()), str(out.resolve()), str(member.run.resolve()),
        str(token.resolve()), secret, stop, engine_hash(), parcel,
    )  # fmt: skip


def _wait(tasks: Sequence[_Task], client: Any, stop: str, what: str, reporter: Reporter, source: Path) -> None:
    """Take the results of tasks as they end; pass a request to stop on to those that have begun."""
    from distributed import Event

    waiting, stopping = list(tasks), False
    while waiting:
        if reporter.stop.asked and not stopping:
            stopping = True
            Event(stop, client=client).set()
            running = {key for keys in client.processing().values() for key in keys}
            for task in [t for t in waiting if t.future.key not in running]:
                task.future.cancel()
                task.member.failure = "not started"
                waiting.remove(task)
        for task in [t for t in waiting if t.future.done()]:
            waiting.remove(task)
            _take(task, source)
            if task.member.failure is not None and not stopping:
                reporter.warn(f"{task.member.name} ({task.member.run}): {task.member.failure}")
        if not stopping:
            begun = [task.member for task in waiting if (task.member.run / RECORD).exists()]
            rest = [task.member for task in waiting if task.member not in begun]
            report_progress([task.member for task in tasks], begun, rest, what, reporter)
        if waiting:
            time.sleep(POLL_INTERVAL)


def _take(task: _Task, source: Path) -> None:
    """Record how a task ended, and unpack the run that came back."""
    if task.future.status != "finished":
        error = task.future.exception() if task.future.status == "error" else None
        name = type(error).__name__
        dead = name == "KilledWorker"
        task.member.failure = (
            f"its workers died, one after another; {GOES_ON}" if dead else f"{name}: {error}" if error else "cancelled"
        )
        return
    outcome: Outcome = task.future.result()
    if outcome.archive:
        _unpack(outcome.archive, task.member.run, source)
    if outcome.code < 0:
        task.member.failure = f"was killed ({signal.Signals(-outcome.code).name}); {GOES_ON}"
    elif outcome.code > 0:
        reason = reason_in(outcome.message, task.member.run.resolve())
        task.member.failure = reason or f"ended with exit code {outcome.code}"


def _unpack(content: bytes, run: Path, source: Path) -> None:
    """Put a run that came back in its place, at once and not file by file; its record names the scene's folder here."""
    with tempfile.TemporaryDirectory(prefix=".sweep-", dir=make_below(run.parent)) as name:
        folder = Path(name) / run.name
        with tarfile.open(fileobj=io.BytesIO(content), mode="r:gz") as archive:
            archive.extractall(folder, filter="data")
        record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        write_json(folder / RECORD, record | {"base": str(source.resolve().parent)})
        if run.exists():
            run.rename(Path(name) / "before")
        folder.rename(run)


@contextmanager
def _client(place: str, at_once: int) -> Iterator[Any]:
    """Yield a client of the cluster at a place; close what was made for it."""
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise _missing(place, error) from None
    with dask.config.set({"distributed.scheduler.allowed-failures": DEATHS - 1}):
        if place.startswith("dask://"):
            address = "tcp://" + place.removeprefix("dask://")
            try:
                client = Client(address, timeout="10s")
            except OSError as error:
                raise UsageError(f"--on {place}: no scheduler answers at {address} ({error})") from None
            with client:
                yield client
        elif place == "dask":
            cluster = LocalCluster(
                n_workers=at_once, threads_per_worker=1, processes=True, dashboard_address=None, memory_limit=0
            )
            with cluster, Client(cluster) as client:
                yield client
        else:
            with _slurm(at_once) as cluster, Client(cluster) as client:
                yield client


def _slurm(at_once: int) -> Any:
    """Return a cluster of `at_once` jobs of Slurm, as the user's Dask configuration describes them."""
    try:
        from dask_jobqueue import SLURMCluster
    except ImportError as error:
        raise _missing("slurm", error) from None
    try:
        cluster = SLURMCluster()
    except ValueError as error:
        raise UsageError(
            f"--on slurm: {error}; describe one job in ~/.config/dask/jobqueue.yaml (cores, memory, walltime, queue)"
        ) from None
    cluster.scale(jobs=at_once)
    return cluster


def _missing(place: str, error: ImportError) -> MissingExtra:
    return MissingExtra(f"--on {place}: needs {error.name}, which is not installed: pip install 'cqrun[dask]'")
