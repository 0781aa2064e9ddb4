"""Tasks side by side: how many threads each is given, and the order of their results."""

import pytest

from cqrun.jobs.side_by_side import side_by_side


@pytest.mark.parametrize(
    ("tasks", "threads", "at_once", "each"),
    [(1, 16, None, 16), (2, 16, None, 8), (3, 16, None, 5), (5, 2, None, 1), (4, 8, 2, 4), (4, 8, 1, 8)],
)
def test_tasks_share_the_threads(tasks, threads, at_once, each):
    found = side_by_side([lambda own, i=i: (i, own) for i in range(tasks)], threads, at_once)
    assert found == [(i, each) for i in range(tasks)]
