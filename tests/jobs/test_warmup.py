"""Kernels are compiled beforehand, and every composition is known by its words."""

from __future__ import annotations

import pytest
from numba import config
from small_beam import BEAM, Listener, changed

from cqrun.build.model import build
from cqrun.jobs.warmup import common_scenes, warmup
from cqrun.running import kernels
from cqrun.running.kernels import compile_kernels, composition, mark_of
from cqrun.scene.load import load_scene

WORDS = "2D float64, fixed_corotated + viscosity, sticky, forward and backward"


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """Keep the marks in a folder of the test's own."""
    monkeypatch.setattr(kernels, "set_kernel_cache", lambda: tmp_path / "cache")
    return tmp_path / "cache"


def test_a_scenes_kernels(beam, cache):
    listener = Listener()
    (line,) = warmup([beam], reporter=listener)
    assert line.endswith(f" s  {WORDS}")
    lasts = "up to a minute"
    assert listener.said == [f"compiling kernels, {lasts} (once for scenes of this kind: {WORDS})"]
    if not config.DISABLE_JIT:
        assert mark_of(WORDS).read_text() == WORDS + "\n"
        assert next(warmup([beam], reporter=listener)).endswith(WORDS)
        assert len(listener.said) == 1
        # whoever has the adjoint has the forward, too
        compile_kernels([build(load_scene(BEAM))], listener, adjoint=False)
        assert len(listener.said) == 1


def test_another_processor_compiles_again(beam, cache, monkeypatch):
    """Numba does so, and computers of several kinds may share a home: it would last a minute without a word."""
    listener = Listener()
    next(warmup([beam], reporter=listener))
    monkeypatch.setattr(kernels, "processor", lambda: ("x86_64-unknown-linux-gnu", "znver9", "+everything"))
    next(warmup([beam], reporter=listener))
    assert len(listener.said) == 2


def test_a_cache_that_cannot_be_written_is_no_trouble(beam, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(kernels, "set_kernel_cache", lambda: tmp_path / "file" / "cache")
    assert len(list(warmup([beam]))) == 1


def test_the_common_scenes_are_of_thirty_two_kinds():
    words = [composition(build(scene), adjoint=True) for scene in common_scenes()]
    assert len(set(words)) == 32
    assert WORDS in words
    assert "3D float64, neo_hookean, friction, forward and backward" in words


def test_words_tell_kernels_apart(beam):
    def words(*overrides: str) -> str:
        return composition(build(load_scene(beam, overrides)), adjoint=False)

    assert words() == WORDS.replace(" and backward", "")
    assert words("time.duration=0.02", "world.dx=0.02", "bodies.beam.material.density=900") == words()
    assert words("precision=float32").startswith("2D float32")
    assert words("world.frame=reference").startswith("2D float64, reference frame, fixed_corotated")
    averaged = words("world.frame=reference", "world.volume=averaged")
    assert averaged.startswith("2D float64, reference frame, averaged volumes, fixed_corotated")
    changed(beam, "viscosity: {shear: 3}", "incompressibility: {power: 2}")
    assert "fixed_corotated + incompressibility, sticky" in words()
    box = "{box: {corner: [0.02, 0.06], size: [0.1, 0.01]}}"
    muscle = f"actuators={{a: {{muscle: {{body: beam, region: {box}, axis: [1, 0], strength: 1}}}}}}"
    assert "incompressibility + muscle, sticky" in words(muscle)
    assert "sticky, friction, forward" in words("boundaries.floor={friction: {face: y_min, coefficient: 0.2}}")
