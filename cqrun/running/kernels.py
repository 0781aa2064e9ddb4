"""Compiling a scene's kernels before they are timed, and saying so only when it really happens.

Numba compiles a kernel for the types it meets: the dimension, the precision, the terms of each body's stress, the
planes of the boundaries. What is compiled lies in a folder named after all kernels (`fingerprint.py`); a mark beside
it, one for each composition, tells a later process that it need not wait.
"""

from __future__ import annotations

import contextlib
import hashlib
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from cqrun.build.model import Built
from cqrun.engine.model import LossBar
from cqrun.engine.rollout import Rollout
from cqrun.errors import RolloutError
from cqrun.fingerprint import set_kernel_cache
from cqrun.running.reporter import Reporter


def composition(built: Built, *, adjoint: bool) -> str:
    """Return in words which kernels a scene needs: scenes with the same words share them."""
    scene, model = built.scene, built.model
    groups = []
    _, steady, forces = model.kinds()
    for group in model.groups:
        material = scene.bodies[model.body_names[group.bodies[0]]].material
        active = [_kind(kind) for kind in group.active]
        groups.append(" + ".join([material.elastic.name, *material.terms, *active]))
    groups += [_kind(kind) for kind in (*steady, *forces)]
    planes = [condition.spec.name for condition in model.conditions]
    kind = "forward and backward" if adjoint else "forward"
    return f"{model.dim}D {scene.precision}, {'; '.join(groups)}, {', '.join(planes) or 'no boundaries'}, {kind}"


def _kind(kernel_class: type) -> str:
    """Return the name of the file that has an actuator's kernels."""
    return kernel_class.__module__.rpartition(".")[2]


def mark_of(words: str) -> Path:
    """Return the file that marks a composition as compiled."""
    digest = hashlib.sha256(words.encode()).hexdigest()[:12]
    return set_kernel_cache() / f"compiled-{digest}.txt"


def compile_kernels(scenes: Sequence[Built], talk: Reporter, *, adjoint: bool) -> float:
    """Have the kernels of scenes ready, compiled or from the cache, by one substep of each kind.

    Args:
        scenes: may share kernels.
        talk: is told when something must be compiled.
        adjoint: whether gradients will be asked for.

    Returns:
        How long it took [s].
    """
    begin = time.perf_counter()
    for words, built in {composition(built, adjoint=adjoint): built for built in scenes}.items():
        if not mark_of(words).exists():
            talk.phase(f"compiling kernels (once for scenes of this kind: {words})")
        try:
            _one_substep(built, adjoint)
        except RolloutError:
            continue  # the job meets the same at its first step, and tells it with its values
        for compiled in {words, composition(built, adjoint=False)}:
            _put_mark(compiled)
    return time.perf_counter() - begin


def _one_substep(built: Built, adjoint: bool) -> None:
    inputs = built.assembly.inputs({})
    inputs.activation = inputs.activation[:1]
    rollout = Rollout(replace(built.model, n_controls=1, substeps=1), inputs, adjoint=adjoint)
    if adjoint:
        rollout.gradient(lambda records, state: LossBar())
    else:
        rollout.run()


def _put_mark(words: str) -> None:
    """Mark a composition as compiled; where that cannot be written, the next process announces it once more."""
    from numba import config

    mark = mark_of(words)
    if not config.DISABLE_JIT and not mark.exists():
        with contextlib.suppress(OSError):
            mark.parent.mkdir(parents=True, exist_ok=True)
            mark.write_text(words + "\n")
