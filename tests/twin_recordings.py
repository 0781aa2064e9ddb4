"""Recordings of the small beam that differ: each has its own tilt, start, offset and load, and the same material."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from small_beam import BEAM, MARKERS

from cqrun.build.matter import matter_of
from cqrun.build.model import build
from cqrun.engine.frames import make_rollout
from cqrun.measurements.markers import observe_markers, over_body
from cqrun.objectives.hermite import interpolant
from cqrun.scene.load import load_scene
from cqrun.store.formats.long_table import write_csv
from cqrun.store.synthetic import make_synthetic

NOISE = 2e-5
"""Standard deviation of each coordinate [m]."""

TIP = "{box: {corner: [0.1, 0.06], size: [0.02, 0.01]}}"
PUSH = f"loads: {{push: {{point_force: {{body: beam, force: [0, 0], region: {TIP}}}}}}}\n"
"""A pre-load at the tip, which a scene has with the force 0."""


def write_twin(
    file: Path, overrides: Sequence[str], *, start: float = 0.02, offset: Sequence[float] = (0, 0), seed: int = 1,
    scene: str = BEAM, markers: Mapping[str, Sequence[float]] = MARKERS,
) -> Path:  # fmt: skip
    """Write a recording of the small beam with its marker positions every 2 ms, and return its file.

    Args:
        overrides: of the scene that the data are made with.
        start: time in the file when the beam is released [s]; it rests before.
        offset: subtracted from the positions [m], so that a recording with this `offset` fits.
        seed: of the noise.
        markers: rest position of each marker [m].
    """
    built = build(load_scene(scene, ["time.substeps=24", *overrides]))
    matter = matter_of(built, {})
    observer = observe_markers(matter, "beam", {name: np.array(x) for name, x in markers.items()})
    model = replace(built.model, probe=over_body(observer.rows, "beam", matter))
    records = make_rollout(model, built.assembly.inputs({})).run()
    time = 0.002 * np.arange(round((start + built.scene.time.duration) / 0.002))
    clean = interpolant(time - start, built.scene.time.control_step, model.n_controls)(*observer.observe(records))
    (made,) = make_synthetic(
        time, tuple(markers), clean - np.array(offset), noise=NOISE, copies=1, rng=np.random.default_rng(seed)
    )
    write_csv(made, file)
    return file
