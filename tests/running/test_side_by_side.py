"""Tasks side by side: how many threads each is given, how many gradients at once, and the order of their results."""

from types import SimpleNamespace

import numpy as np
import pytest

from cqrun.running.gradient_memory import gradient_time, gradients_at_once, state_bytes
from cqrun.running.side_by_side import side_by_side


@pytest.mark.parametrize(
    ("tasks", "threads", "at_once", "each"),
    [(1, 16, None, 16), (2, 16, None, 8), (3, 16, None, 5), (5, 2, None, 1), (4, 8, 2, 4), (4, 8, 1, 8)],
)
def test_tasks_share_the_threads(tasks, threads, at_once, each):
    found = side_by_side([lambda own, i=i: (i, own) for i in range(tasks)], threads, at_once)
    assert found == [(i, each) for i in range(tasks)]


def model(states: int, *, steps: int = 800, particles: int = 84384):
    """Return what a plan of gradients asks of a model whose budget is so many states."""
    layout = SimpleNamespace(n=particles, n_particles=particles)
    made = SimpleNamespace(n_steps=steps, dim=3, layout=layout, real=np.float64, substeps=4, memory_budget=0)
    made.memory_budget = states * state_bytes(made)
    return made


@pytest.mark.parametrize(
    ("states", "threads", "count"), [(132, 16, 16), (132, 12, 12), (132, 8, 8), (40, 4, 4), (33, 4, 9), (5, 2, 2)]
)
def test_gradients_at_once_end_soonest(states, threads, count):
    """As many as fit starve each other: they would run the substeps again up to 50 times."""
    models = [model(states)] * count
    found = gradients_at_once(models, threads)
    times = [-(-count // k) * gradient_time(models[0], k, threads) for k in range(1, min(threads, count) + 1)]
    assert times[found - 1] == pytest.approx(min(times)) or found == 1
    assert all(np.isinf(times)) == (states == 5)


def test_those_that_starve_wait_for_each_other():
    starving = model(132)
    assert gradient_time(starving, 13, 16) > 50
    assert 2 * gradient_time(starving, 8, 16) < 0.2 * 2 * gradient_time(starving, 13, 16)
    assert gradients_at_once([starving] * 16, 16) <= 8
    assert gradients_at_once([starving, model(10**4)] * 8, 16) <= 8


@pytest.mark.parametrize("particles", [100, 5000, 84384])
def test_all_threads_have_gradients_where_all_states_fit(particles):
    """More at once is never slower then, whatever the numbers."""
    for threads in range(1, 21):
        for count in range(1, 21):
            models = [model(20 * 801, particles=particles)] * count
            assert gradients_at_once(models, threads) == min(threads, count)
