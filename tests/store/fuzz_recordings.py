"""Read recordings with a few changed bytes, in a process with little memory: python fuzz_recordings.py KIND COUNT SEED.

It prints how many were read and how many refused. Whatever else happens ends it: a traceback, a crash, more than 2 GB
or more than 20 s for one file. The changed file is then in the folder that it names.
"""

from __future__ import annotations

import os
import random
import resource
import signal
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import h5py
import numpy as np
from made_c3d import DEC, INTEL, MIPS, hand_made, write_c3d

from cqrun.errors import UsageError
from cqrun.measurements.plausible import plausible
from cqrun.measurements.recording import Recording
from cqrun.store.frames import Frames
from cqrun.store.marker_csv import write_csv
from cqrun.store.recordings import read_recording
from cqrun.store.trajectory import TrajectoryWriter

SECONDS, MEMORY = 20, 2 << 30
SHARED = Path(os.environ.get("CQRUN_SHARED_DATA", Path(__file__).parents[3] / "shared" / "data")) / "realbeam"
TEXT = b'0123456789.,-e"\n'
NAMES = ("Tip - 1", "Tip - 2", "Base")


def seeds(kind: str, folder: Path) -> list[bytes]:
    """Return the files that are changed."""
    rng = np.random.default_rng(1)
    x = 0.25 * np.round(100 * rng.normal(size=(24, 3, 3)))
    if kind == "c3d":
        files = [write_c3d(folder / "ezc3d.c3d", x, names=NAMES), *SHARED.glob("*.c3d")]
        forms = [(processor, scale) for processor in (INTEL, DEC, MIPS) for scale in (-0.25, 0.25)]
        files += [hand_made(folder / f"{p}{s}.c3d", x, processor=p, scale=s, analog=2, names=NAMES) for p, s in forms]
    elif kind == "csv":
        files = [folder / "long.csv"]
        x[5, 1] = np.nan
        write_csv(Recording(0.01 * np.arange(24), NAMES, x, "made"), files[0])
    else:
        files = [folder / "plain.h5", folder / "run.h5"]
        with h5py.File(files[0], "w") as file:
            file["time"], file["particles/x"] = 0.01 * np.arange(24), x
        with TrajectoryWriter(files[1], 24, {"beam": slice(0, 3)}, 3, {"v": (3,)}, {"seed": 1}) as writer:
            for k in range(24):
                writer.write(k, 0.01 * k, x=x[k], v=x[k])
    return [file.read_bytes() for file in files]


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Return a file with one to four bytes changed; three times of four among its first 4,096."""
    changed = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        place = rng.randrange(min(len(data), 4096 if rng.random() < 0.75 else len(data)))
        flipped = changed[place] ^ (1 << rng.randrange(8))
        changed[place] = rng.choice((rng.randrange(256), 0, 0xFF, 0x7F, 0x80, flipped, *rng.sample(TEXT, 4)))
    return bytes(changed)


def read(path: Path) -> None:
    """Read a file in every way in which it may be used."""
    plausible(read_recording(path), 100.0, (0.0, 1.0))


def read_frames(path: Path) -> None:
    """Read a trajectory as pictures and `compress` do."""
    with Frames(path) as frames:
        for name in frames.fields:
            frames.read_all(name)


def attempt(path: Path, reader: Callable[[Path], None]) -> bool:
    """Return whether a file is read, and not refused."""
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        reader(path)
    except UsageError:
        return False
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    return True


def too_long(number: int, frame: FrameType | None) -> None:
    raise TimeoutError(f"more than {SECONDS} s")


def main(kind: str, count: int, seed: int) -> None:
    """Read `count` changed files."""
    np.seterr(all="raise", under="ignore")
    folder = Path(tempfile.mkdtemp())
    print(folder, flush=True)
    files, rng, path = seeds(kind, folder), random.Random(seed), folder / f"changed.{kind}"
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
    signal.signal(signal.SIGALRM, too_long)
    done = 0
    for _ in range(count):
        path.write_bytes(mutated(rng.choice(files), rng))
        done += attempt(path, read)
        if kind == "h5":
            attempt(path, read_frames)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{count} files: {done} read, {count - done} refused, at most {peak:.0f} MB")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
