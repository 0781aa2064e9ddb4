"""All figures and tables, in the papers' order."""

from benchmarks.papers.figure import Figure
from benchmarks.papers.figures.cq1_arm_reach import ArmReach
from benchmarks.papers.figures.cq1_biped_ppo import BipedAgainstPPO
from benchmarks.papers.figures.cq1_fig3 import LegActuated, LegDropped
from benchmarks.papers.figures.cq1_fig4 import Biped
from benchmarks.papers.figures.cq1_fig5 import Poses
from benchmarks.papers.figures.cq1_fig6 import Crawler, Quadruped
from benchmarks.papers.figures.cq1_fig7 import FixedGoal, RandomGoal, WideGoal
from benchmarks.papers.figures.cq1_fig8 import TwoLinkArm
from benchmarks.papers.figures.cq1_inference import Inference
from benchmarks.papers.figures.cq1_table2 import Speed
from benchmarks.papers.figures.cq1_table3 import Accuracy
from benchmarks.papers.figures.cq2_fig5 import FingerMaterial
from benchmarks.papers.figures.cq2_fig6 import CableBiped
from benchmarks.papers.figures.cq2_fig7 import Rhino
from benchmarks.papers.figures.cq2_fig8 import TerrainBiped
from benchmarks.papers.figures.cq2_fig9 import Creature
from benchmarks.papers.figures.cq2_fig10 import SwingingArm
from benchmarks.papers.figures.cq2_fig11_to_14 import (
    BipedAblation,
    HexapodAblation,
    OctopodAblation,
    QuadrupedAblation,
)
from benchmarks.papers.figures.cq2_fracture import Fracture
from benchmarks.papers.figures.cq2_length_arm import LengthArm
from benchmarks.papers.figures.cq2_oscillator import Oscillator
from benchmarks.papers.figures.cq2_seconds import Seconds
from benchmarks.papers.figures.real_beam import RealBeam

_ORDER: tuple[type[Figure], ...] = (
    Speed, Accuracy, Inference, LegActuated, LegDropped, Biped, BipedAgainstPPO, Poses, Quadruped, Crawler, FixedGoal,
    RandomGoal, WideGoal, ArmReach, TwoLinkArm, FingerMaterial, CableBiped, Rhino, TerrainBiped, Creature,
    SwingingArm, BipedAblation, QuadrupedAblation, HexapodAblation, OctopodAblation, LengthArm, Oscillator, Fracture,
    Seconds, RealBeam,
)  # fmt: skip

FIGURES: dict[str, Figure] = {kind.id: kind() for kind in _ORDER}
