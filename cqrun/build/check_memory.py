"""Check that a scene fits the free memory, before anything of that size is made; the problems say what would be right.

Counts are estimated as floats, which hold any product of the numbers in a scene.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cqrun.engine.setting import grid_shape
from cqrun.errors import Problem, SceneError
from cqrun.geometry.place import Place
from cqrun.memory import shortage
from cqrun.scene.schema import Scene
from cqrun.state import Layout

DOUBLE = 8
"""Size of a float64 [bytes]."""

POINT = 100
"""Bytes of a lattice point while a shape is filled: its position, and what is computed of it."""

SIGNALS = 8
"""Numbers of an actuator in a control step: its activation, its derivatives, and what they are computed from."""

EPISODE = 1000
"""Bytes of the goals of an episode, and of its place in a run."""

Need = tuple[str, str, float, str]
"""Key path, what needs memory, bytes, and advice."""


def require_memory(scene: Scene, layout: Layout | None = None) -> None:
    """Raise a SceneError for the parts of a scene that need more memory than is free.

    Args:
        scene: the scene; the files that shapes are made from can be read.
        layout: its particles; if None, what is known without them is checked.
    """
    needs = _needs(scene) if layout is None else _needs_with(scene, layout)
    problems = [
        Problem(scene.where(path), path, lack)
        for path, what, need, advice in needs
        if (lack := shortage(f"{what} need", need, advice))
    ]
    if problems:
        raise SceneError(problems)


def _grid(scene: Scene) -> tuple[str, float]:
    """Return what the grid is in words, and the bytes that it needs."""
    shape = np.array(grid_shape(np.array(scene.world.size), scene.world.dx), float)
    with np.errstate(over="ignore"):
        nodes = float(np.prod(shape))
    return f"{nodes:.3g} grid nodes", nodes * (3 * 4 * np.dtype(scene.precision).itemsize + DOUBLE)


def _needs(scene: Scene) -> Iterator[Need]:
    """Yield what is known before there are particles."""
    yield "world", *_grid(scene), "use a larger dx or a smaller world"
    for name, body in scene.bodies.items():
        spacing, scale = body.particle_spacing(scene.world.dx), (body.place or Place()).scale
        for path, shape in body.pieces.items():
            points = body.sampling.value.estimate(shape, None if spacing is None else spacing / scale)
            what = f"{points:.3g} points that may be particles"
            yield f"bodies.{name}.{path}", what, POINT * points, "fill it less densely, or check its size and its unit"
    yield from _records(scene, rows=1)
    yield from _signals(scene)
    episodes = float(scene.episodes.count) + float(scene.episodes.unseen)
    yield "episodes", f"{episodes:.3g} episodes", EPISODE * episodes, "use fewer"


def _records(scene: Scene, rows: int) -> Iterator[Need]:
    """Yield what is kept of every control step: at least one marker, and every actuator."""
    steps = float(scene.time.control_steps)
    what = f"the records of {steps:.3g} control steps"
    advice = "use fewer control steps, with longer ones or a shorter run"
    yield "time.duration", what, DOUBLE * steps * (rows + SIGNALS * (1 + len(scene.actuators))), advice
    synthetic = scene.synthetic
    if synthetic is not None:
        frames = float(synthetic.key_frames or steps // (synthetic.every or 1) + 1)
        points = synthetic.tracked or len(synthetic.markers or {})
        recordings = float(synthetic.copies) * scene.sequences
        size = DOUBLE * recordings * frames * points * scene.dim
        yield "data.synthetic.copies", f"{recordings:,.0f} recordings", size, "make fewer copies"


def _signals(scene: Scene) -> Iterator[Need]:
    """Yield what open-loop signals need: the share of every knot in every control step."""
    steps, random = float(scene.time.control_steps), scene.activation.random if scene.activation is not None else None
    if random is not None:
        what = f"{random.knots:.3g} knots over {steps:.3g} control steps"
        yield "activation.random.knots", what, DOUBLE * steps * (random.knots + SIGNALS), "use fewer knots"
        what = f"the signals of {random.sequences:.3g} sequences over {steps:.3g} control steps"
        size = DOUBLE * steps * random.sequences * len(scene.actuators)
        yield "activation.random.sequences", what, size, "use fewer sequences"
    for name, knots in (scene.activation.signals or {}).items() if scene.activation is not None else ():
        what = f"{len(knots):,} knots over {steps:.3g} control steps"
        yield f"activation.signals.{name}", what, DOUBLE * steps * len(knots), "use fewer knots"


def _needs_with(scene: Scene, layout: Layout) -> Iterator[Need]:
    """Yield what is known once there are particles."""
    what, grid = _grid(scene)
    working = grid + layout.n * (100 + 4 * scene.dim**2) * np.dtype(scene.precision).itemsize
    yield "world", f"{what} and {layout.n_particles} particles", working, "use a larger dx or a smaller world"
    yield from _records(scene, layout.table.n_rows)
