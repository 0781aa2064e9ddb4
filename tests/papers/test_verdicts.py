"""Verdicts on learners, on constrained robots and on seconds: what they ask for, and what is not enough."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.papers.catalogue import FIGURES
from benchmarks.papers.families.learners import GRADIENT, PPO
from benchmarks.papers.families.violations import DESIGNED, effort_ratio
from benchmarks.papers.figure import Judgement, Size, table_of


def learned(ends):
    """Return a table of CQ1 Fig 7, middle, where each method reaches its end (episode, measure) and stays there."""
    return table_of(
        {"method": method, "seed": 0, "episode": k + 1, "measure": 0.1 if k + 1 < episode else measure}
        for method, (episode, measure) in ends.items()
        for k in range(1500)
    )


@pytest.mark.parametrize(
    ("ours", "ppo", "found"),
    [
        ((10, 0.001), (400, 0.004), Judgement.EXCEEDED),
        ((30, 0.0024), (400, 0.004), Judgement.MET),  # the end is the paper's
        ((30, 0.0026), (400, 0.0022), Judgement.PARTLY),  # PPO ends nearer, which it does not in the paper
        ((30, 0.004), (400, 0.0049), Judgement.PARTLY),  # farther away than the paper's
        ((120, 0.0024), (400, 0.004), Judgement.PARTLY),  # later than the paper's
        ((10, 0.001), None, Judgement.PARTLY),  # PPO was not run
    ],
)
def test_what_is_asked_of_the_gradient_beside_ppo(ours, ppo, found):
    figure = FIGURES["cq1_fig7_random"]
    table = learned({GRADIENT: ours} | ({PPO: ppo} if ppo else {}))
    assert figure.judge(table, Size.PAPER).judgement is found


def test_unfinished_learners_are_judged_by_the_episodes_so_far():
    """An unfinished figure shows its checks; what has not been run meets none of them."""
    figure = FIGURES["cq1_fig7_random"]
    for ends in ({PPO: (400, 0.004)}, {GRADIENT: (10, 0.001), PPO: (400, 0.004)}):
        table = learned(ends)
        early = {name: column[table["episode"] <= 1000] for name, column in table.items()}
        checks = figure.judge(early, Size.PAPER).checks
        assert [met for text, met in checks.items() if text.startswith("after 1500")] == [False]
        assert [met for text, met in checks.items() if text.startswith("nearer than PPO")] == [False]
        assert all(met is (GRADIENT in ends) for text, met in checks.items() if text.startswith("below"))
        assert figure.draw(early, Size.PAPER, {}).axes


def test_ppo_may_end_nearer_where_it_does_in_the_paper():
    checks = FIGURES["cq1_fig7_fixed"].judge(learned({GRADIENT: (5, 0.001), PPO: (50, 0.0005)}), Size.PAPER).checks
    assert all(checks.values())
    assert not any("nearer than PPO" in text for text in checks)


def test_efforts_are_compared_after_as_many_iterations_as_in_the_paper():
    """They keep falling: one design's was lower after 93 iterations, and more than twice the other after 45."""
    efforts = {DESIGNED: {14: 0.95, 93: 0.17}, "fixed 100 %": {30: 0.40}}
    table = table_of(
        {"robot": robot, "iteration": k, "violation": 0.0 if k in met else 1.0, "effort": met.get(k, 0.01)}
        for robot, met in efforts.items()
        for k in range(101)
    )
    figure = FIGURES["cq1_fig8"]
    assert effort_ratio(figure, table, "fixed 100 %", 0.955, 45) == {
        "least effort in 45 iterations 2.375 of fixed 100 % (0.425 at the end of the searches), paper 0.955": False
    }
    assert list(effort_ratio(figure, table, "fixed 100 %", 0.955, 100).values()) == [True]
    assert list(effort_ratio(figure, table, "fixed 100 %", 0.955, 20).values()) == [
        False
    ]  # not both meet the constraints
    (text,) = figure.designed_is_first(table)
    assert "co-design 14, fixed 100 % 30" in text


def test_of_quick_seconds_only_the_order_is_judged():
    figure = FIGURES["cq2_seconds"]
    rows = [{"robot": "a", "printed": 12.0, "ns": 400.0, "steps": 1e8}, {"robot": "b", "printed": 6.0, "ns": 300.0}]
    table = table_of(iter([rows[0], rows[1] | {"steps": 1e8}]))
    assert figure.judge(table, Size.QUICK).judgement is Judgement.MET
    slow = {**table, "ns": np.array([400.0, 500.0])}
    assert figure.judge(slow, Size.QUICK).judgement is Judgement.MISSED
    assert len(figure.draw({**table, "seconds": np.ones(2)}, Size.QUICK, {}).axes) == 1
