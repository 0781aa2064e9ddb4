"""What does not fit the memory is refused with its cause, before anything of that size is made."""

from __future__ import annotations

import tracemalloc
from types import SimpleNamespace
from typing import Any

import pytest
from small_beam import BEAM, FIT

from cqrun.build.model import build
from cqrun.errors import SceneError
from cqrun.scene.load import load_scene

MUSCLE = "actuators={m: {muscle: {body: beam, axis: [1, 0], strength: 1}}}"
RANDOM = "activation={random: {sequences: 2, knots: 3}}"
SIGNAL = f"activation={{signals: {{m: {[0.1] * 1000}}}}}"
MOST = 20 * 2**20
"""More than a refusal allocates [bytes]; what is refused asks for a gigabyte at least."""


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["world.dx=1e-8"],
            "world: 1.92e+14 grid nodes need 1.82e+04 TiB; 1 GiB are free: use a larger dx or a smaller",
        ),
        (["world.dx=1e-100"], "world: 1.92e+198 grid nodes need 1.82e+188 TiB; 1 GiB are free"),
        (["world.size=[1e30, 1e30]", "world.dx=1e-100"], "world: 1e+260 grid nodes need 9.46e+249 TiB; 1 GiB are free"),
        (["bodies.beam.particles_per_cell=1e9"], "bodies.beam.shape: 1e+10 points that may be particles need"),
        (["bodies.beam.particles_per_cell=1e30"], "bodies.beam.shape: 1e+31 points that may be particles need"),
        (
            ["bodies.beam.particles_per_cell=null", "bodies.beam.sampling={lattice: {count: 9000000000000000000}}"],
            "bodies.beam.shape: 8.1e+37 points that may be particles need",
        ),
        (
            ["bodies.beam.particles_per_cell=null", "bodies.beam.sampling={random: {count: 20000000}}"],
            "bodies.beam.shape: 2e+07 points that may be particles need 1.86 GiB",
        ),
        (["bodies.beam.particles_per_cell=160000"], "world: 480 grid nodes and 1600000 particles need"),
        (["time.control_step=1e-9"], "time.duration: the records of 1e+08 control steps need"),
        (["time.control_step=1e-100"], "time.duration: the records of 1e+99 control steps need 6.55e+88 TiB"),
        ([MUSCLE, RANDOM, "activation.random.knots=100000000"], "activation.random.knots: 1e+08 knots over 10 control"),
        (
            [MUSCLE, RANDOM, "activation.random.sequences=10000", "time.control_step=5e-6", "time.substeps=1"],
            "activation.random.sequences: the signals of 1e+04 sequences over 2e+04 control steps need",
        ),
        ([MUSCLE, SIGNAL, "time.control_step=5e-7"], "activation.signals.m: 1,000 knots over 2e+05 control steps need"),
        (["episodes.count=9000000000000000000"], "episodes: 9e+18 episodes need"),
        (["episodes.unseen=10000000"], "episodes: 1e+07 episodes need"),
        (["data.synthetic.copies=1000000000000"], "data.synthetic.copies: 1,000,000,000,000 recordings need"),
        (
            ["data.synthetic.key_frames=9000000000000000000", "data.synthetic.every=null"],
            "data.synthetic.copies: 1 recordings need",
        ),
    ],
)
def test_what_needs_more_than_is_free_is_refused_before_it_is_made(
    monkeypatch: pytest.MonkeyPatch, overrides: list[str], message: str
) -> None:
    free = SimpleNamespace(available=2**30, total=2**31)
    monkeypatch.setattr("psutil.virtual_memory", lambda: free)
    scene = load_scene(BEAM + FIT if "data." in overrides[0] else BEAM, ["time.substeps=auto", *overrides])
    tracemalloc.start()
    with pytest.raises(SceneError) as info:
        build(scene)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert message in str(info.value)
    assert peak < MOST or "particles need" in message  # which are counted when they are made


@pytest.mark.parametrize("count", [1, 1000])
def test_what_fits_is_built(count: int) -> None:
    scene: Any = load_scene(BEAM, [MUSCLE, RANDOM, f"activation.random.sequences={count}", f"episodes.count={count}"])
    assert build(scene).model.n_steps == 240
