"""Measure the convergence tables: cqrun's frames against independent references.

    python -m benchmarks.convergence                          # 2D, all frames of this version, 2 4 8 cells
    python -m benchmarks.convergence --dim 3 --cells 4 8 --tests swing --minutes 30

A finished point is a row of benchmarks/measured/convergence.csv and is not measured again, so a stopped command
continues. --again also measures points that another version of the engine has measured. Plots go to docs/convergence.
A frame that this version, or a test's scene, cannot do is skipped, and the command says so.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.convergence import block_tests, cantilever_sag, cantilever_swing, disc, slender, turning_bar
from benchmarks.convergence.plots import draw
from benchmarks.convergence.points import NoReference, Point, Test
from benchmarks.convergence.table import Table
from benchmarks.convergence.worlds import FRAMES, frames_of_this_version
from cqrun.errors import RolloutError, SceneError
from cqrun.fingerprint import engine_hash
from cqrun.optimizers.base import one_blas_thread

ROOT = Path(__file__).parents[2]
OUT, PICTURES = ROOT / "benchmarks" / "measured" / "convergence.csv", ROOT / "docs" / "convergence"
TESTS: tuple[Test, ...] = (
    cantilever_swing.TEST, cantilever_sag.TEST, slender.ELASTICA, slender.COLUMN, turning_bar.TEST,
    block_tests.BOUNCE, block_tests.REST, disc.TEST, block_tests.INCLINE,
)  # fmt: skip


def known_frames(wanted: list[str]) -> Iterator[str]:
    """Yield the wanted frames that scenes of this version can have; say which are skipped."""
    known = frames_of_this_version()
    for frame in wanted:
        if frame in known:
            yield frame
        else:
            print(f"frame {frame}: skipped, because this version has only {', '.join(known)}")


def measure(test: Test, point: Point, table: Table) -> None:
    """Measure a point and add its row.

    A scene that is refused, or that has no reference, gets no row; one that blows up, or finds no rest, gets a note.
    """
    start = time.monotonic()
    try:
        with one_blas_thread():
            values = test.row(test.measure(point))
    except (SceneError, NoReference) as error:
        reason = error.problems[0] if isinstance(error, SceneError) else error
        print(f"{' '.join(point.key)}: skipped: {reason}", flush=True)
        return
    except (RolloutError, ValueError) as error:
        table.add(point, {}, time.monotonic() - start, engine_hash(), str(error).splitlines()[0])
        print(f"{' '.join(point.key)}: {error}", flush=True)
        return
    table.add(point, values, time.monotonic() - start, engine_hash())
    print(f"{' '.join(point.key)}: {'  '.join(f'{k} {v:.4g}' for k, v in values.items())}", flush=True)


def main() -> None:
    """Measure the points that have no row, and draw the plots."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tests", nargs="+", choices=[test.name for test in TESTS], default=[t.name for t in TESTS])
    parser.add_argument("--frames", nargs="+", default=list(FRAMES))
    parser.add_argument("--dim", type=int, choices=(2, 3), default=2)
    parser.add_argument("--cells", nargs="+", type=int, default=[2, 4, 8])
    parser.add_argument("--minutes", type=float, default=float("inf"), help="start no point after this time")
    parser.add_argument("--again", action="store_true", help="measure again what another engine has measured")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--pictures", type=Path, default=PICTURES)
    options = parser.parse_args()
    table, begin = Table(options.out, TESTS), time.monotonic()
    tests = [test for test in TESTS if test.name in options.tests]
    wanted = [
        (test, point)
        for frame in known_frames(options.frames)
        for cells in options.cells
        for test in tests
        for point in test.points(frame, options.dim, cells)
        if not table.has(point, engine_hash() if options.again else None)
    ]
    for done, (test, point) in enumerate(wanted):
        if time.monotonic() - begin > 60.0 * options.minutes:
            print(f"time is up: {len(wanted) - done} points are left; the same command continues")
            break
        measure(test, point, table)
    for test in tests:
        if (picture := draw(test, table, options.pictures, options.dim)) is not None:
            print(picture)


if __name__ == "__main__":
    main()
