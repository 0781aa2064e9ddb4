"""The cases of synthetic data: one per sequence of activations, with its noisy copies."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from cqrun.build.matter import matter_of
from cqrun.build.model import Built
from cqrun.engine.frames import make_rollout
from cqrun.fitting.case import Case
from cqrun.measurements.markers import in_the_scenes_frame, observe_markers, over_body
from cqrun.measurements.points import Points, particles
from cqrun.measurements.recording import Recording
from cqrun.measurements.window import Window
from cqrun.objectives.hermite import interpolant
from cqrun.observers.matter import Matter
from cqrun.scene.data import Synthetic
from cqrun.scene.unknowns import truths
from cqrun.store.atomic import replacing
from cqrun.store.folder import SYNTHETIC, make_below
from cqrun.store.formats.long_table import write_csv
from cqrun.store.recordings import read_recording
from cqrun.store.synthetic import make_synthetic

CHECK = b"# crc32 %d\n"
"""The last line of a file with data that a run has made."""


def synthetic_cases(built: Built, spec: Synthetic, directory: Path | None, interrupt: Callable[[], None]) -> list[Case]:
    """Return the cases of a scene's synthetic data; keep the data in a directory, if one is given.

    `interrupt` as `make_cases`.
    """
    scene, matter = built.scene, matter_of(built, {})
    rng = np.random.default_rng(spec.seed)
    names, observer = _observed(spec, matter, rng)
    rows = over_body(observer.rows, spec.body, matter)
    base = replace(built, model=replace(built.model, probe=rows))
    random = scene.activation is not None and scene.activation.random is not None
    cases = []
    for sequence in range(scene.sequences):
        name = f"sequence_{sequence}" if random else "synthetic"
        interrupt()
        variant = replace(base, assembly=base.assembly.with_sequence(sequence))
        model = variant.model
        comparisons = tuple(
            in_the_scenes_frame(
                recording, observer, rows,
                Window(model.dt * model.substeps, model.n_controls, start=0.0, source=recording.source),
            )
            for recording in _made(variant, spec, name, names, observer, rng, directory)
        )  # fmt: skip
        cases.append(Case(name, variant, comparisons))
    return cases


def _observed(spec: Synthetic, matter: Matter, rng: np.random.Generator) -> tuple[tuple[str, ...], Points]:
    """Return the names of the observed points, and their observer."""
    if spec.markers is not None:
        rest = {name: np.array(position) for name, position in spec.markers.items()}
        return tuple(rest), observe_markers(matter, spec.body, rest)
    part = matter.bodies[spec.body]
    count = part.stop - part.start
    chosen = np.sort(rng.choice(count, int(spec.tracked or 0), replace=False))
    return tuple(f"particle {index}" for index in chosen), particles(chosen, count)


def _made(
    built: Built, spec: Synthetic, name: str, names: tuple[str, ...], observer: Points, rng: np.random.Generator,
    directory: Path | None,
) -> list[Recording]:  # fmt: skip
    """Return the noisy copies of a sequence: read them from the run, or make and write them."""
    draw = np.random.default_rng(rng.integers(2**63))  # one generator per sequence, whether its files exist or not
    files = [(directory / SYNTHETIC / f"{name}_{copy}.csv") if directory else None for copy in range(spec.copies)]
    if all(file is not None and _is_whole(file) for file in files):
        return [read_recording(file) for file in files if file is not None]
    truth = {path: np.asarray(value, float) for path, value in truths(built.scene).items()}
    records = make_rollout(built.model, built.assembly.inputs(truth)).run()
    steps, step = built.model.n_controls, built.scene.time.control_step
    if spec.every is not None:
        time = np.unique([*range(0, steps, spec.every), steps]) * step
    else:
        time = np.linspace(0.0, steps * step, int(spec.key_frames or 0))
    clean = interpolant(time, step, steps)(*observer.observe(records))
    made = make_synthetic(time, names, clean, noise=spec.noise, copies=spec.copies, rng=draw, source=name)
    for recording, file in zip(made, files, strict=True):
        if file is not None and directory is not None:
            make_below(directory, SYNTHETIC)
            with replacing(file) as temporary:  # a run that is killed here will not read an incomplete file
                write_csv(recording, temporary)
                _guard(temporary)
    return made


def _guard(file: Path) -> None:
    """Add a last line with the CRC-32 of the others, which readers of recordings skip as a comment."""
    with file.open("rb+") as content:
        content.write(CHECK % zlib.crc32(content.read()))


def _is_whole(file: Path) -> bool:
    """Return whether data that the run has made is as it was written; else it is made again, with the same numbers."""
    content = file.read_bytes() if file.is_file() else b""
    before = content.rpartition(CHECK.partition(b"%")[0])[0]
    return content == before + CHECK % zlib.crc32(before)
