"""CQ1 V-B: a biped learns to walk, by the gradient and by PPO."""

from benchmarks.papers.families.learners import CMA, GRADIENT, PPO, Learners
from benchmarks.papers.figure import Size, Table, Verdict, lowered


class BipedAgainstPPO(Learners):
    """The loss against the episode."""

    id = "cq1_biped_ppo"
    title = "A biped learns to walk, with and without the gradient"
    source = "CQ1 V-B"
    paper = "the gradient walks well within 20 minutes; PPO moves nearly at random after more than 4 hours"
    tolerance = {
        Size.QUICK: "the gradient passes each threshold in fewer episodes than PPO and CMA-ES",
        Size.PAPER: "the gradient passes each threshold in fewer episodes than PPO and CMA-ES; in part at best, for "
        "the paper counts minutes",
    }
    left_open = (
        "time is counted in episodes: they cost the gradient about three times a plain rollout, by which CMA-ES is "
        "sooner at both thresholds at the paper's size, and at one of them at quick size. PPO was given 1,000 "
        "episodes, not four hours. Losses are means over ten episodes; of CMA-ES every sixteen the best one counts, "
        "and after 2,400 it is lower (-.71 to -.86) than the gradient after its 100 (-.26 to -.63 without the mean)"
    )
    scene, label, optimizer = "control/biped", "loss: -x + v^2 of the head", "sgd"
    small = ("bodies.biped.sampling.lattice.count=10", "world.dx=0.04")
    distance, squared = False, ""
    episodes = {
        GRADIENT: {Size.QUICK: 60, Size.PAPER: 100},
        CMA: {Size.QUICK: 480, Size.PAPER: 2400},
        PPO: {Size.QUICK: 150, Size.PAPER: 1000},
    }
    minutes = {
        GRADIENT: {Size.QUICK: 1, Size.PAPER: 6},
        CMA: {Size.QUICK: 1.7, Size.PAPER: 40},
        PPO: {Size.QUICK: 3.3, Size.PAPER: 60},
    }
    seeds, trials = {Size.QUICK: 2, Size.PAPER: 10}, {Size.QUICK: 2, Size.PAPER: 3}
    thresholds = (-0.1, -0.2)
    windows = {GRADIENT: 10, PPO: 10}

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge episodes; the paper's minutes and hours are not met with that."""
        verdict = super().judge(table, size)
        if size is Size.QUICK:
            return verdict
        return lowered(verdict, {"counted in minutes, PPO for more than 4 hours, as in the paper": False})
