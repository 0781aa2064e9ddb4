"""CQ2 Fig 6: a biped walks on four cables."""

from benchmarks.papers.families.distances import SINGLE, Distances, Variant
from benchmarks.papers.figure import Size

CABLES = ("back_left", "back_right", "front_left", "front_right")
QUICK = ("bodies.biped.spacing=0.00625", "optimizer.adam.max_iterations=40")


def _stiffness(value: float) -> tuple[str, ...]:
    return tuple(f"actuators.{name}.cable.stiffness={value:g}" for name in CABLES)


class CableBiped(Distances):
    """Its distance against the iteration, at our stiffness of the cables and at half and double of it."""

    id = "cq2_fig6"
    title = "A biped walks on four cables"
    source = "CQ2 Fig 6"
    paper = (
        "from -.10 to .58 m in 100 iterations, at its peak .65 (90 %: .47 to .80, most likely there); 12 s each; mean "
        "of 10 runs; its text: two body lengths in 5 minutes"
    )
    left_open = (
        "the cables' stiffness: 4.3e5, at which u = 0 leaves .70 of a leg; half and double are shown too. At quick "
        "size the biped tears in the last .2 of its 4 s, as it lunges; at the paper's size nobody watched as it ran"
    )
    scene, body = "control/biped_cable", "biped"
    start, final, interval, interval_at, seconds = -0.10, 0.58, (0.47, 0.80), "at its peak of .65: ", 12.0
    variants = (
        Variant("stiffness 4.3e5", {Size.QUICK: QUICK, Size.PAPER: SINGLE}, {Size.QUICK: 2, Size.PAPER: 10},
                {Size.QUICK: 2.2, Size.PAPER: 70}),
        Variant("half", {Size.PAPER: (*SINGLE, *_stiffness(2.15e5))}, {Size.PAPER: 3}, {Size.PAPER: 21}),
        Variant("double", {Size.PAPER: (*SINGLE, *_stiffness(8.6e5))}, {Size.PAPER: 3}, {Size.PAPER: 21}),
    )  # fmt: skip
