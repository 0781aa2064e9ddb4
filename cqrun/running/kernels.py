"""Compile a scene's kernels before its run is timed, and announce it only if compiling is necessary.

Numba compiles a kernel for the types of its arguments. These depend on the dimension, the precision, the terms of each
body's stress, and the planes of the boundaries: together they are the composition of a scene. The compiled code is in
a folder named after all kernels (`fingerprint.py`). There a mark file for each composition, processor and installation
shows a later process that its kernels are compiled.
"""

from __future__ import annotations

import contextlib
import hashlib
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from cqrun.build.model import Built
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import LossBar
from cqrun.engine.rigid_model import count_free
from cqrun.errors import RolloutError
from cqrun.fingerprint import set_kernel_cache
from cqrun.numerics.compile import CACHE_PROBLEMS
from cqrun.numerics.linking import OPTIMISING
from cqrun.running.reporter import Reporter

LASTS = {False: "up to half a minute", True: "up to a minute"}
"""How long compiling takes on one core, with and without the adjoint."""

FUNCTIONS = {False: 200, True: 270}
"""About how many functions are compiled for a scene, with and without the adjoint; with rigid bodies it is more."""


def composition(built: Built, *, adjoint: bool) -> str:
    """Return in words which kernels a scene needs; scenes with the same words share their kernels."""
    scene, model = built.scene, built.model
    groups = []
    _, steady, forces = model.kinds()
    for group in model.groups:
        material = scene.bodies[model.body_names[group.bodies[0]]].material
        active = [_kind(kind) for kind in group.active]
        groups.append(" + ".join([material.elastic.name, *material.terms, *active]))
    groups += [_kind(kind) for kind in (*steady, *forces)]
    planes = (
        [condition.spec.name for condition in model.conditions]
        + ["contact"] * bool(model.obstacles)
        + ["rigid bodies"] * bool(model.rigid)
        + ["skins"] * bool(model.obstacles and count_free(model.rigid))
        + ["meeting bodies"] * (model.meeting is not None)
        + ["reactions"] * bool(model.reactions)
        + ["reactions of obstacles"] * any(c.spec.is_obstacle and c.name in model.reactions for c in model.conditions)
        + ["reactions of rigid bodies"] * any(body.name in model.reactions for body in model.rigid)
    )
    kind = "forward and backward" if adjoint else "forward"
    frame = (", reference frame" if model.frame == "reference" else "") + (
        ", averaged volumes" if model.averaged else ""
    )
    words = f"{'; '.join(groups)}, {', '.join(planes) or 'no boundaries'}, {kind}"
    return f"{model.dim}D {scene.precision}{frame}, {words}"


def _kind(kernel_class: type) -> str:
    """Return the name of the file with an actuator's kernels."""
    return kernel_class.__module__.rpartition(".")[2]


def processor() -> tuple[str, ...]:
    """Return the processor's kind, name and features, by which Numba distinguishes compiled code."""
    from numba.core.registry import cpu_target

    return tuple(str(part) for part in cpu_target.target_context.codegen().magic_tuple())


def mark_of(words: str) -> Path:
    """Return the file that marks a composition as compiled, for this processor.

    Numba compiles again for another one, and computers of several kinds may share a home.
    """
    digest = hashlib.sha256("\0".join((words, *processor())).encode()).hexdigest()[:12]
    return set_kernel_cache() / f"compiled-{digest}.txt"


def compile_kernels(scenes: Sequence[Built], reporter: Reporter, *, adjoint: bool) -> float:
    """Run one substep of each composition, so that its kernels are compiled or loaded from the cache.

    Args:
        scenes: scenes of the same composition are compiled once.
        reporter: receives a message if something must be compiled.
        adjoint: whether gradients will be computed.

    Returns:
        The time it took [s].
    """
    begin = time.perf_counter()
    for words, built in {composition(built, adjoint=adjoint): built for built in scenes}.items():
        if not mark_of(words).exists():
            reporter.phase(f"compiling kernels, {LASTS[adjoint]} (once for scenes of this kind: {words})")
        try:
            with reporter.stop.deferred(False), _told(reporter, adjoint):  # nothing is lost, and it may take minutes
                _one_substep(built, adjoint)
        except RolloutError:
            continue  # the job fails at its first step as well, and reports it with its values
        for compiled in {words, composition(built, adjoint=False)} if not any(CACHE_PROBLEMS.values()) else ():
            _write_mark(compiled)
    while CACHE_PROBLEMS:
        reporter.warn(CACHE_PROBLEMS.popitem()[0])
    return time.perf_counter() - begin


@contextlib.contextmanager
def _told(reporter: Reporter, adjoint: bool) -> Iterator[None]:
    """Show what is compiled, and how much of it, while Numba compiles."""
    from numba.core import event

    listener = _listener(event.Listener, reporter, FUNCTIONS[adjoint])
    kinds = ("numba:compile", OPTIMISING)
    for kind in kinds:
        event.register(kind, listener)
    try:
        yield
    finally:
        for kind in kinds:
            event.unregister(kind, listener)


def _listener(base: type, reporter: Reporter, total: int) -> Any:
    """Return what Numba tells of every function that it compiles: it calls others, which it compiles meanwhile."""

    class Listener(base):
        depth = done = 0
        kernel = ""

        def on_start(self, told: Any) -> None:
            if told.kind == OPTIMISING:
                reporter.advance(self.done, self.whole, f"{self.kernel}: optimising all of it")
                return
            if self.depth == 0:
                self.kernel = told.data["dispatcher"].py_func.__name__.strip("_")
            self.depth += 1

        def on_end(self, told: Any) -> None:
            if told.kind == OPTIMISING:
                return
            self.depth -= 1
            self.done += 1
            reporter.advance(self.done, self.whole, f"{self.kernel}: function {self.done} of about {self.whole}")

        @property
        def whole(self) -> int:
            return max(total, self.done + self.depth)

    return Listener()


def _one_substep(built: Built, adjoint: bool) -> None:
    inputs = built.assembly.inputs({})
    inputs.activation = inputs.activation[:1]
    rollout = make_rollout(replace(built.model, n_controls=1, substeps=1), inputs, adjoint=adjoint)
    if adjoint:
        rollout.gradient(lambda records, state: LossBar())
    else:
        rollout.run()


def _write_mark(words: str) -> None:
    """Mark a composition as compiled; if the mark cannot be written, the next process announces compiling again."""
    from numba import config

    mark = mark_of(words)
    if not config.DISABLE_JIT and not mark.exists():
        with contextlib.suppress(OSError):
            mark.parent.mkdir(parents=True, exist_ok=True)
            mark.write_text(words + "\n", encoding="utf-8")
