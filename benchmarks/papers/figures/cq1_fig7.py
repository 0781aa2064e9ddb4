"""CQ1 Fig 7: a finger reaches for a goal, with the gradient and with PPO; the goal is fixed or random."""

from benchmarks.papers.families.learners import CMA, GRADIENT, PPO, Learners
from benchmarks.papers.figure import Size

SMALL = ("bodies.finger.sampling.lattice.count=20",)
ADDED = "The comparison of the ends with PPO's, and the rule for 'exceeded', were added after the runs"
CRITERIA = {
    Size.QUICK: "the gradient passes each threshold in fewer episodes than PPO (and than CMA-ES, where that is shown)",
    Size.PAPER: "the gradient passes each threshold in fewer episodes than PPO (and than CMA-ES, where that is shown), "
    "and in no more episodes than the paper's. It ends at most a tenth farther away than the paper's, and nearer than "
    "PPO where the paper's does. Exceeded if it is better than each of the paper's numbers by more than a tenth",
}


class FixedGoal(Learners):
    """The goal is always the same."""

    id = "cq1_fig7_fixed"
    title = "A finger reaches for a fixed goal"
    source = "CQ1 Fig 7, left"
    paper = (
        "the gradient is below 0.02 and 0.01 m after 21 and 31 episodes (means over 10), PPO after 108 and 127; in the "
        "end they are at 0.0066 and 0.0045 m. The text says an order of magnitude sooner; the curves of all three "
        "tasks say 4 to 7 times"
    )
    criteria = CRITERIA
    notes = (
        "For CMA-ES the best of every sixteen episodes (one generation) counts, so no count is below "
        "seventeen. An episode costs the gradient about three plain rollouts; if that is counted, CMA-ES is sooner. "
        "Without the mean over ten episodes the gradient needs 3 and 4 episodes, and PPO 44 and 62 (medians). Our PPO, "
        "that of stable-baselines3 with its defaults, needs more episodes than the paper's, so our gap is wider than "
        f"the printed one. {ADDED}"
    )
    scene, label, optimizer, small = "control/finger", "distance of the tip [m]", "sgd", SMALL
    episodes = {
        GRADIENT: {Size.QUICK: 60, Size.PAPER: 350},
        CMA: {Size.QUICK: 480, Size.PAPER: 2400},
        PPO: {Size.QUICK: 300, Size.PAPER: 1500},
    }
    minutes = {
        GRADIENT: {Size.QUICK: 0.3, Size.PAPER: 12},
        CMA: {Size.QUICK: 0.3, Size.PAPER: 10},
        PPO: {Size.QUICK: 0.8, Size.PAPER: 25},
    }
    thresholds = (0.02, 0.01)
    windows = {GRADIENT: 10, PPO: 10}
    printed = {GRADIENT: [(21, 0.02), (31, 0.01), (350, 0.0066)], PPO: [(108, 0.02), (127, 0.01), (350, 0.0045)]}


class RandomGoal(Learners):
    """Every episode has a new goal."""

    id = "cq1_fig7_random"
    title = "A finger reaches for random goals"
    source = "CQ1 Fig 7, middle"
    paper = (
        "the gradient is below 0.01 and 0.005 m after 132 and 203 episodes (means over 100), and ends at 0.0025 m; "
        "PPO is below them after 656 and 1,384 episodes, and ends at 0.005 m"
    )
    criteria = CRITERIA
    notes = (
        "CQ1's gradient descent does not come below 0.005 here. We use Adam, with a learning rate of 0.03 that falls "
        "to half after 200 episodes. With a constant 0.03, ten seeds passed 0.01 and 0.005 after 127 and 159 "
        "episodes, but most left their optimum again after about 1,100 episodes and ended at 0.0043. All seeds see "
        f"the same goals. Our PPO needs fewer episodes than the paper's. {ADDED}, and so was the falling rate"
    )
    scene, label, optimizer, small = "control/finger_random", "distance of the tip [m]", "adam", SMALL
    episodes = {GRADIENT: {Size.QUICK: 200, Size.PAPER: 1500}, PPO: {Size.QUICK: 600, Size.PAPER: 1500}}
    minutes = {GRADIENT: {Size.QUICK: 0.4, Size.PAPER: 40}, PPO: {Size.QUICK: 1.6, Size.PAPER: 16}}
    thresholds = (0.01, 0.005)
    windows = {GRADIENT: 100, PPO: 100}
    printed = {GRADIENT: [(132, 0.01), (203, 0.005), (1500, 0.0025)], PPO: [(656, 0.01), (1384, 0.005), (1500, 0.005)]}


class WideGoal(Learners):
    """Every episode has a new goal, from a larger range."""

    id = "cq1_fig7_wide"
    title = "A finger reaches for random goals of a larger range"
    source = "CQ1 Fig 7, right"
    paper = (
        "the gradient is below 0.015 and 0.01 m after 282 and 438 episodes (means over 100), and ends at 0.0077 m; "
        "PPO is below them after 1,322 episodes and never (in 3,500), and ends at 0.0125 m"
    )
    criteria = CRITERIA
    notes = (
        "CQ1's gradient descent is slower here, so we use Adam with a learning rate of 0.03. All seeds see the same "
        "goals. One of ten seeds stays at 0.011. Our PPO, too, needs fewer episodes than the paper's, and ends nearer. "
        f"{ADDED}"
    )
    scene, label, optimizer, small = "control/finger_wide", "distance of the tip [m]", "adam", SMALL
    episodes = {GRADIENT: {Size.QUICK: 200, Size.PAPER: 3500}, PPO: {Size.QUICK: 600, Size.PAPER: 3500}}
    minutes = {GRADIENT: {Size.QUICK: 0.4, Size.PAPER: 95}, PPO: {Size.QUICK: 1.5, Size.PAPER: 38}}
    thresholds = (0.015, 0.01)
    windows = {GRADIENT: 100, PPO: 100}
    printed = {GRADIENT: [(282, 0.015), (438, 0.01), (3500, 0.0077)], PPO: [(1322, 0.015), (3500, 0.0125)]}
