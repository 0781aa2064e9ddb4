"""CQ1 Fig 3: a pneumatic leg bends, and falls; the simulated rows (the photographs cannot be simulated)."""

import numpy as np

from benchmarks.papers.families.frames import Frames
from benchmarks.papers.families.integrity import WHOLE, checks
from benchmarks.papers.figure import Size, Table, Verdict, judged, lowered
from benchmarks.papers.machinery.work import Runs
from cqrun.plugin.contract import Array

COARSE = ("bodies.leg.spacing=0.25", "world.dx=0.8", "time.substeps=80")
STICKY = {
    "leg_drop": "boundaries.floor.sticky.region={box: {corner: [-1, -1, -1], size: [82, 2.61, 82]}}",
    "leg_actuate": "boundaries.floor.sticky.region={box: {corner: [-1, -1, -1], size: [82, 3.4, 82]}}",
}
"""Where the floor ends, in whole cells of the coarse grid."""

G = 980.0
"""Gravity of the scene [cm/s^2]."""


class LegActuated(Frames):
    """Frames of the leg as one chamber is inflated."""

    id = "cq1_fig3_actuate"
    title = "A pneumatic leg bends"
    source = "CQ1 Fig 3, left"
    paper = "photographs beside frames: a chamber is inflated more and more, and the leg bends away from it"
    tolerance = {size: f"the middle moves away from the inflated chamber by more than .5 cm; {WHOLE}" for size in Size}
    left_open = (
        "which chamber, and how long: 30 frames up to a stress of 1.5e7, for beyond 1.8e7 the chamber bursts (the "
        "paper's 200 frames would come to 1e8); real footage cannot be reproduced"
    )
    name, body, group, count, columns, unit = "leg_actuate", "leg", "core", 5, 5, "cm"

    def work(self, size: Size) -> list[Runs]:
        """Return the simulation."""
        quick = size is Size.QUICK
        small = (*COARSE, STICKY[self.name]) if quick else ()
        return [Runs(self.name, 0.4 if quick else 3.5, "simulate", "simulate/leg_actuate", small)]

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge how far the core bends: to the right, as the left chamber grows."""
        far = float(table["x"][-1] - table["x"][0])
        lasted = float(table["time"][-1])
        verdict = judged({f"the core's middle moves {far:.2f} cm away in {lasted:g} s": far > 0.5})
        return lowered(verdict, checks(table))


class LegDropped(Frames):
    """Frames of the leg as it falls."""

    id = "cq1_fig3_drop"
    title = "A pneumatic leg falls 15 cm"
    source = "CQ1 Fig 3, right"
    paper = "photographs beside frames: the leg falls 15 cm, is squeezed and springs back"
    tolerance = {
        size: f"it falls as a free body until it lands, is squeezed, and springs back; {WHOLE}" for size in Size
    }
    left_open = "how long; real footage cannot be reproduced"
    name, body, group, count, columns, unit = "leg_drop", "leg", "core", 6, 6, "cm"

    def work(self, size: Size) -> list[Runs]:
        """Return the simulation."""
        quick = size is Size.QUICK
        small = (*COARSE, STICKY[self.name]) if quick else ()
        return [Runs(self.name, 0.4 if quick else 3.5, "simulate", "simulate/leg_drop", small)]

    def moments(self, table: Table) -> Array:
        """Return the start, half the fall, just before it is lowest, that, the highest after, and the end."""
        y = table["y"]
        lowest = int(y.argmin())
        return np.array([0, lowest // 2, lowest - 1, lowest, lowest + int(y[lowest:].argmax()), len(y) - 1])

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge fall and rebound of the core's middle."""
        time, y = table["time"], table["y"]
        falling = time <= 0.1
        error = float(abs((y[0] - G / 2 * time[falling] ** 2) - y[falling]).max())
        lowest = int(y.argmin())
        back = float(y[lowest:].max() - y[lowest])
        pressed = float(table["least_volume_ratio"][~falling].min())
        verdict = judged({
            f"falls freely within {error:.2g} cm for .1 s": error < 0.05,
            f"is lowest after {time[lowest]:.3f} s, {y[0] - y[lowest]:.1f} cm lower": y[0] - y[lowest] > 14.0,
            f"is squeezed, to {pressed:.2f} of its volume where most": pressed < 0.95,
            f"springs back by {back:.2f} cm": back > 0.1,
        })  # fmt: skip
        return lowered(verdict, checks(table))
