"""CQ1 Fig 7: a finger reaches for a goal, by the gradient and by PPO; the goal is fixed, or drawn from two ranges."""

from benchmarks.papers.families.learners import CMA, GRADIENT, PPO, Learners
from benchmarks.papers.figure import Size

SMALL = ("bodies.finger.sampling.lattice.count=20",)
SETTLED = "That ends are compared with PPO's, and what is exceeded, was settled after the runs"
TOLERANCE = {
    Size.QUICK: "the gradient passes each threshold in fewer episodes than PPO (and CMA-ES, where that is shown)",
    Size.PAPER: "the gradient passes each threshold in fewer episodes than PPO (and CMA-ES, where that is shown), and "
    "in no more than the paper's, and ends no more than a tenth farther away than the paper's, and nearer than PPO "
    "where the paper's does; exceeded where it is better than each of the paper's numbers by more than a tenth",
}


class FixedGoal(Learners):
    """The goal is always the same."""

    id = "cq1_fig7_fixed"
    title = "A finger reaches for a fixed goal"
    source = "CQ1 Fig 7, left"
    paper = (
        "below .02 and .01 m after 21 and 31 episodes (means over 10); PPO 108 and 127; at the end .0066 and .0045 m; "
        "its text: an order of magnitude sooner (its curves of all three tasks: 4 to 7 times)"
    )
    tolerance = TOLERANCE
    left_open = (
        "of CMA-ES every sixteen episodes the best one counts, as a generation has, so none before the seventeenth. "
        "An episode costs the gradient about three plain rollouts, by which CMA-ES is sooner. Without the mean over "
        "ten the gradient needs 3 and 4 episodes, PPO 44 and 62 (medians). Our PPO, stable-baselines3's with its "
        f"defaults, needs more episodes than the paper's did, so the gap is wider than printed. {SETTLED}"
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
    """The goal is drawn anew for every episode."""

    id = "cq1_fig7_random"
    title = "A finger reaches for random goals"
    source = "CQ1 Fig 7, middle"
    paper = (
        "below .01 and .005 m after 132 and 203 episodes (means over 100), .0025 m in the end; PPO 656 and 1,384, "
        ".005 m"
    )
    tolerance = TOLERANCE
    left_open = (
        "CQ1's descent misses .005 here; Adam is used instead, at .03 and falling (to half after 200 episodes). At a "
        "constant .03 ten seeds passed .01 and .005 after 127 and 159 episodes, but most left their optimum again "
        "after some 1,100 and ended at .0043. All seeds see the same goals. Our PPO needs fewer episodes than the "
        f"paper's. {SETTLED}, as was the falling rate"
    )
    scene, label, optimizer, small = "control/finger_random", "distance of the tip [m]", "adam", SMALL
    episodes = {GRADIENT: {Size.QUICK: 200, Size.PAPER: 1500}, PPO: {Size.QUICK: 600, Size.PAPER: 1500}}
    minutes = {GRADIENT: {Size.QUICK: 0.4, Size.PAPER: 40}, PPO: {Size.QUICK: 1.6, Size.PAPER: 16}}
    thresholds = (0.01, 0.005)
    windows = {GRADIENT: 100, PPO: 100}
    printed = {GRADIENT: [(132, 0.01), (203, 0.005), (1500, 0.0025)], PPO: [(656, 0.01), (1384, 0.005), (1500, 0.005)]}


class WideGoal(Learners):
    """The goal is drawn anew for every episode, from a larger range."""

    id = "cq1_fig7_wide"
    title = "A finger reaches for random goals of a larger range"
    source = "CQ1 Fig 7, right"
    paper = (
        "below .015 and .01 m after 282 and 438 episodes (means over 100), .0077 m in the end; PPO 1,322 and never in "
        "3,500, .0125 m"
    )
    tolerance = TOLERANCE
    left_open = (
        "CQ1's descent is slower here; Adam at .03 is used instead. All seeds see the same goals. One seed of ten "
        f"stays at .011. Our PPO, too, needs fewer episodes than the paper's, and ends nearer. {SETTLED}"
    )
    scene, label, optimizer, small = "control/finger_wide", "distance of the tip [m]", "adam", SMALL
    episodes = {GRADIENT: {Size.QUICK: 200, Size.PAPER: 3500}, PPO: {Size.QUICK: 600, Size.PAPER: 3500}}
    minutes = {GRADIENT: {Size.QUICK: 0.4, Size.PAPER: 95}, PPO: {Size.QUICK: 1.5, Size.PAPER: 38}}
    thresholds = (0.015, 0.01)
    windows = {GRADIENT: 100, PPO: 100}
    printed = {GRADIENT: [(282, 0.015), (438, 0.01), (3500, 0.0077)], PPO: [(1322, 0.015), (3500, 0.0125)]}
