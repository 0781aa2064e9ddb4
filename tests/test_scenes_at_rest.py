"""The shipped scenes of equilibria, on coarser cells and with simpler bodies."""

from __future__ import annotations

from pathlib import Path

import pytest
from small_beam import result_of

from cqrun.jobs.rest import REST
from cqrun.jobs.table import report_lines
from cqrun.scene.load import load_scene

SCENES = sorted((Path(__file__).parents[1] / "scenes").rglob("*.yaml"))

HOLLOW = (
    "{difference: [{box: {corner: [0, 0, 0], size: [0.1, 0.02, 0.02]}}, "
    "{box: {corner: [0.004, 0.004, 0.004], size: [0.092, 0.012, 0.012]}}]}"
)


def pipe(x: float, ends: tuple[float, float], hole: tuple[float, float], radius: float) -> str:
    """Return a thick pipe along z around (x, x), closed at both ends, whose hole has a radius of 6 mm."""
    outer, inner = (f"start: [{x}, {x}, {low}], end: [{x}, {x}, {high}]" for low, high in (ends, hole))
    return f"{{difference: [{{cylinder: {{{outer}, radius: {radius}}}}}, {{cylinder: {{{inner}, radius: 0.006}}}}]}}"


COARSE = {
    "bellows": [
        "world.dx=0.004", f"bodies.bellows.shape={pipe(0.022, (0.006, 0.042), (0.014, 0.034), 0.015)}",
        "path={actuators.air.chamber.pressure: [100]}",
    ],
    "fiber_reinforced": [
        "world.dx=0.004", "bodies.tube.spacing=0.002",
        f"bodies.tube.shape={pipe(0.018, (0.012, 0.084), (0.02, 0.076), 0.015)}",
        "path={actuators.air.chamber.pressure: [100]}",
    ],
    "indenter": ["world.dx=0.006", "path={rigid.ball.offset.2: [-0.002]}"],
    "tensile_bar": ["world.dx=0.005", "path={boundaries.head.sticky.displacement.0: [0.012]}"],
    "pneunet": [
        "world.dx=0.004", "bodies.actuator.spacing=0.002", f"bodies.actuator.shape={HOLLOW}",
        "bodies.actuator.groups.layer.box.size.2=0.002", "path={actuators.air.chamber.pressure: [100]}",
    ],
}  # fmt: skip
"""Overrides that make an equilibrium faster to find than those of `world.dx`."""


@pytest.mark.parametrize("path", [p for p in SCENES if load_scene(p).job == "rest"], ids=lambda path: path.stem)
def test_a_path_has_an_equilibrium_at_every_point(path, tmp_path):
    run = REST.run(path, COARSE.get(path.stem, ["world.dx=0.01"]), tmp_path, threads=1)
    result = result_of(run)
    assert result["status"] == "done"
    assert result["findings"] == []
    assert all(point["residual"] < 1e-8 for point in result["points"])
    assert next(iter(report_lines(run))).startswith("done: ")
