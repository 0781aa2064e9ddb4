"""Recordings of a beam in every format, the scenes that read them, and damage to their bytes."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from made_c3d import DEC, INTEL, MIPS, hand_made, write_c3d
from made_tables import motive, qualisys, trc, vicon, wide

from cqrun.measurements.recording import Recording
from cqrun.store.formats.long_table import write_csv
from cqrun.store.trajectory import TrajectoryWriter

SHARED = Path(os.environ.get("CQRUN_SHARED_DATA", Path(__file__).parents[3] / "shared" / "data")) / "realbeam"

NAMES = ("Tip - 1", "Tip - 2", "Tip - 3", "Base - 1", "Base - 2", "Base - 3")
REST = np.array(
    [[0.14, 0.045, 0.126], [0.14, 0.024, 0.114], [0.14, 0.066, 0.096],
     [0.046, 0.02, 0.089], [0.046, 0.07, 0.1175], [0.046, 0.07, 0.09]]
)  # fmt: skip

BEAM = """\
cqrun: 1
job: sysid
world: {size: [0.17, 0.09, 0.16], dx: 0.01, gravity: [0, 0, -9.81], frame: updated}
bodies:
  beam:
    shape: {box: {corner: [0.03, 0.03, 0.09], size: [0.11, 0.03, 0.03]}}
    particles_per_cell: 1
    material: {density: 1070, elastic: {fixed_corotated: {youngs_modulus: 3.0e5, poissons_ratio: 0.45}}}
boundaries:
  clamp: {sticky: {region: {box: {corner: [0, 0, 0], size: [0.04, 0.09, 0.16]}}}}
unknowns:
  bodies.beam.material.elastic.fixed_corotated.youngs_modulus: {bounds: [1.0e5, 1.0e6], scale: log}
time: {duration: 0.2, control_step: 0.01}
"""

FIT = "data: {{recordings: {{r: {{file: {file}, start: {start}, {still}markers: {{{markers}}}}}}}}}\n"
FOLLOW = """\
objective:
  follow: {{track: {{body: beam, marker: {{file: {file}, marker: '{marker}', start: {start}, relative: true}}}}}}
"""


@dataclass(frozen=True)
class Original:
    """A recording that is as it should be.

    Attributes:
        suffix: of its name.
        content: its bytes.
        names: of the six markers.
        own_axes: whether they are not the scene's.
    """

    suffix: str
    content: bytes
    names: tuple[str, ...] = NAMES
    own_axes: bool = False

    def scenes(self, file: str) -> list[str]:
        """Return scenes that use it: aligned by frames at rest, as a path to follow, and in the axes of the scene."""
        markers = ", ".join(f"'{name}': {x.tolist()}" for name, x in zip(self.names, REST, strict=True))
        aligned = FIT.format(file=file, start=0.52, still="still: [0.2, 0.48], ", markers=markers)
        absolute = FIT.format(file=file, start=0.2, still="", markers=markers)
        follow = FOLLOW.format(file=file, start=0.52, marker=self.names[0])
        return [BEAM + aligned, BEAM + follow, *([] if self.own_axes else [BEAM + absolute])]


def swing() -> Recording:
    """Return the beam at 50 Hz: at rest for half a second, then swinging, with gaps and noise."""
    rng = np.random.default_rng(1)
    time = 0.02 * np.arange(50)
    bend = 0.01 * np.cos(20 * np.maximum(time - 0.5, 0)) - 0.01
    x = REST + bend[:, None, None] * np.array([[0.1, 0, 1]] * 3 + [[0, 0, 0.05]] * 3)
    x = x + 1e-5 * rng.normal(size=x.shape)
    x[30:33, 1] = np.nan
    return Recording(time, NAMES, x, "made")


def originals(folder: Path) -> list[Original]:
    """Return recordings in every format and form; the real ones, too, where they are."""
    recording = swing()
    x, mm = recording.positions, 1000 * recording.positions
    seen = np.where(np.isnan(x), -1.0, x)
    forms = [(processor, scale) for processor in (INTEL, DEC, MIPS) for scale in (-0.01, 0.01)]
    path = folder / "made.c3d"
    write_c3d(path, x, names=NAMES, rate=50.0, residuals=np.where(np.isnan(x[..., 0]), -1.0, 0.1))
    found = [Original(".c3d", path.read_bytes())]
    for processor, scale in forms:
        hand_made(path, mm, processor=processor, scale=scale, rate=50.0, analog=2, names=NAMES)
        found.append(Original(".c3d", path.read_bytes()))
    found += [Original(".c3d", file.read_bytes(), own_axes=True) for file in sorted(SHARED.glob("*.c3d"))]
    write_csv(recording, path)
    found += 5 * [Original(".csv", path.read_bytes())]
    for make, suffix in ((wide, ".csv"), (motive, ".csv"), (vicon, ".csv"), (qualisys, ".tsv"), (trc, ".trc")):
        found.append(Original(suffix, make(mm, NAMES, 50.0).encode()))
    numbered = tuple(map(str, range(len(NAMES))))
    return found + [Original(".h5", content, numbered) for content in _trajectories(folder, recording.time, seen)]


def _trajectories(folder: Path, time: np.ndarray, x: np.ndarray) -> Iterator[bytes]:
    """Yield trajectories: two as other programs write them, whole and in chunks, and one of cqrun."""
    for name, options in {"plain.h5": {}, "packed.h5": {"chunks": (7, 6, 3), "compression": "gzip"}}.items():
        with h5py.File(folder / name, "w") as file:
            file["time"] = time
            file.create_dataset("particles/x", data=x, **options)
        yield (folder / name).read_bytes()
    with TrajectoryWriter(folder / "run.h5", len(x), {"beam": slice(0, 6)}, 3, {"v": (3,)}, {"seed": 1}) as writer:
        for k, frame in enumerate(x):
            writer.write(k, float(time[k]), x=frame, v=frame)
    yield (folder / "run.h5").read_bytes()


# --- damage -----------------------------------------------------------------------------------------------------------

HEAD = 4096
"""Three damages of four are among so many first bytes: what a file says of itself is there."""

WORDS = (
    b"\0\0", b"\xff\xff", b"\xff\x7f", b"\0\x80", b"\0\0\0\0", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f",
    b"\0\0\xc0\x7f", b"\0\0\x80\x7f", b"\xca\xf2\x49\x71", b"\x71\x49\xf2\xca", b"\x01\0\0\0", b"\0\0\0\0\0\0\xf0\x7f",
    b"\xff" * 8, b"\0" * 8, b"\xff\xff\xff\xff\xff\xff\xff\x7f",
)  # fmt: skip
"""Numbers at the edges of what they can be: counts, places, floats (NaN, infinity, 1e30)."""

TOKENS = (
    b"", b"nan", b"inf", b"-inf", b"0", b"-0", b"1e30", b"-1e30", b"1e308", b"1e400", b"1e-320", b"9" * 400, b"0x10",
    b"1_0", b"1,5", b"--1", b'"', b'"1\n', b"\x1b[2J", b"\0", b"\xff", b"\xc2\xa0", b"Tip - 1", b"Tip - 2", b"time",
    b"x" * 200_000, b"\n", b"\r", b"\t", b";", b"#",
)  # fmt: skip
"""Values that a cell of a text file does not have."""

HEADERS = (
    b"Format Version,1.23,Take Name,beam\n", b"Trajectories\n100\n", b"NO_OF_FRAMES\t500\n",
    b"PathFileType\t4\t(X/Y/Z)\n", b"time,tip_x,tip_y,tip_z\n", b"time;marker;x;y;z\n", b"time,marker,x,y\n",
    b"\xff\xfet\0i\0m\0e\0", b"\x02\x50", b"\x89HDF\r\n\x1a\n", b"PK\x03\x04",
)  # fmt: skip
"""Beginnings of files of other programs."""


def damaged(original: Original, rng: np.random.Generator) -> bytes:
    """Return the content of a recording with one to three damages."""
    kinds = BINARIES if original.suffix in (".c3d", ".h5") else TEXTS
    content = original.content
    for _ in range(int(rng.choice([1, 2, 3], p=[0.6, 0.3, 0.1]))):
        content = kinds[rng.integers(len(kinds))](content, rng)
    return content


def _place(content: bytes, rng: np.random.Generator) -> int:
    size = len(content) if rng.random() < 0.25 else min(HEAD, len(content))
    return int(rng.integers(max(size, 1)))


def _bytes(content: bytes, rng: np.random.Generator) -> bytes:
    """Change one to four bytes: one bit, or all."""
    changed = bytearray(content)
    for _ in range(int(rng.integers(1, 5)) if content else 0):
        at = _place(content, rng)
        changed[at] = changed[at] ^ (1 << rng.integers(8)) if rng.random() < 0.5 else rng.integers(256)
    return bytes(changed)


def _word(content: bytes, rng: np.random.Generator) -> bytes:
    word = WORDS[rng.integers(len(WORDS))]
    at = _place(content, rng) & ~1
    return content[:at] + word + content[at + len(word) :]


def _part(content: bytes, rng: np.random.Generator) -> bytes:
    """Cut, remove, double, or fill with zeros, as after a power cut."""
    first = _place(content, rng)
    last = first + int(rng.integers(1, 600))
    rests = (b"", content[last:], 2 * content[first:last] + content[last:], bytes(len(content) - first))
    return content[:first] + rests[rng.integers(len(rests))]


def _cell(content: bytes, rng: np.random.Generator) -> bytes:
    lines = content.split(b"\n")
    at = int(rng.integers(len(lines)))
    separator = b"\t" if b"\t" in lines[at] else b","
    cells = lines[at].split(separator)
    cells[rng.integers(len(cells))] = TOKENS[rng.integers(len(TOKENS))]
    lines[at] = separator.join(cells)
    return b"\n".join(lines)


def _line(content: bytes, rng: np.random.Generator) -> bytes:
    """Remove, double or exchange lines, or sort them otherwise."""
    lines = content.split(b"\n")
    first, second = sorted(rng.integers(len(lines), size=2).tolist())
    match rng.integers(4):
        case 0:
            del lines[first]
        case 1:
            lines.insert(second, lines[first])
        case 2:
            lines[first], lines[second] = lines[second], lines[first]
        case _:
            lines[first:second] = sorted(lines[first:second], reverse=True)
    return b"\n".join(lines)


def _header(content: bytes, rng: np.random.Generator) -> bytes:
    rest = content if rng.random() < 0.5 else content.partition(b"\n")[2]
    return HEADERS[rng.integers(len(HEADERS))] + rest


Damage = Callable[[bytes, np.random.Generator], bytes]
BINARIES: tuple[Damage, ...] = (_bytes, _bytes, _word, _word, _part)
TEXTS: tuple[Damage, ...] = (_bytes, _cell, _cell, _line, _part, _header)
