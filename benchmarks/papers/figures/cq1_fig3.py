"""CQ1 Fig 3: a pneumatic leg bends, and falls. The simulated rows only; photographs cannot be simulated."""

from collections.abc import Sequence

import numpy as np

from benchmarks.papers.families.frames import Frames
from benchmarks.papers.families.integrity import INTACT, checks
from benchmarks.papers.figure import Size, Table, Verdict
from benchmarks.papers.machinery.runs import Runs
from cqrun.plugin.contract import Array

COARSE = ("bodies.leg.spacing=0.25", "world.dx=0.8", "time.substeps=80")
STICKY = {
    "leg_drop": "boundaries.floor.sticky.region={box: {corner: [-1, -1, -1], size: [82, 2.61, 82]}}",
    "leg_actuate": "boundaries.floor.sticky.region={box: {corner: [-1, -1, -1], size: [82, 3.4, 82]}}",
}
"""Where the floor ends, in whole cells of the coarse grid."""

G = 980.0
"""Gravity of the scene [cm/s^2]."""


class Leg(Frames):
    """Frames of the leg; `name` is the scene's."""

    body, group, unit = "leg", "core", "cm"

    def tasks(self, size: Size) -> Sequence[Runs]:
        """Return the simulation."""
        scene = f"simulate/{self.name}"
        if size is Size.QUICK:
            return [Runs(self.name, 0.4, "simulate", scene, (*COARSE, STICKY[self.name]))]
        return [Runs(self.name, 3.5, "simulate", scene)]


class LegActuated(Leg):
    """Frames of the leg while one chamber is inflated."""

    id = "cq1_fig3_actuate"
    title = "A pneumatic leg bends"
    source = "CQ1 Fig 3, left"
    paper = "photographs beside frames: a chamber is inflated more and more, and the leg bends away from it"
    criteria = {
        size: f"the middle of the core moves away from the inflated chamber by more than 0.5 cm; {INTACT}"
        for size in Size
    }
    notes = (
        "We chose which chamber is inflated, and for how long: 30 frames up to a stress of 1.5e7. Beyond 1.8e7 the "
        "chamber bursts, and the paper's 200 frames would end at 1e8. Real footage cannot be reproduced"
    )
    name, count, columns = "leg_actuate", 5, 5

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge how far the core bends to the right while the left chamber grows."""
        distance, duration = float(table["x"][-1] - table["x"][0]), float(table["time"][-1])
        text = f"the middle of the core moves {distance:.2f} cm away in {duration:g} s"
        return Verdict.of({text: distance > 0.5}).also(checks(table))


class LegDropped(Leg):
    """Frames of the leg while it falls."""

    id = "cq1_fig3_drop"
    title = "A pneumatic leg falls 15 cm"
    source = "CQ1 Fig 3, right"
    paper = "photographs beside frames: the leg falls 15 cm, is squeezed and springs back"
    criteria = {size: f"it falls freely until it lands, is squeezed, and springs back; {INTACT}" for size in Size}
    notes = "We chose the duration. Real footage cannot be reproduced"
    name, count, columns = "leg_drop", 6, 6

    def moments(self, table: Table) -> Array:
        """Return the start, half the fall, just before the lowest point, that, the highest after it, and the end."""
        y = table["y"]
        lowest = int(y.argmin())
        return np.array([0, lowest // 2, lowest - 1, lowest, lowest + int(y[lowest:].argmax()), len(y) - 1])

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge the fall and the rebound of the core's middle."""
        time, y = table["time"], table["y"]
        falling = time <= 0.1
        error = float(abs((y[0] - G / 2 * time[falling] ** 2) - y[falling]).max())
        lowest = int(y.argmin())
        rebound = float(y[lowest:].max() - y[lowest])
        least_volume = float(table["least_volume_ratio"][~falling].min())
        verdict = Verdict.of({
            f"falls freely within {error:.2g} cm for 0.1 s": error < 0.05,
            f"is lowest after {time[lowest]:.3f} s, {y[0] - y[lowest]:.1f} cm lower": y[0] - y[lowest] > 14.0,
            f"is squeezed: the least volume ratio of a particle is {least_volume:.2f}": least_volume < 0.95,
            f"springs back by {rebound:.2f} cm": rebound > 0.1,
        })  # fmt: skip
        return verdict.also(checks(table))
