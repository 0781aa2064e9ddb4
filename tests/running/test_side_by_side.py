"""Tasks in parallel: the threads of each, the number of gradients at once, and the order of the results."""

from types import SimpleNamespace

import numpy as np
import pytest

from cqrun.running.gradient_memory import gradient_time, gradients_at_once
from cqrun.running.side_by_side import side_by_side
from cqrun.state import state_table


@pytest.mark.parametrize(
    ("tasks", "threads", "at_once", "each"),
    [(1, 16, None, 16), (2, 16, None, 8), (3, 16, None, 5), (5, 2, None, 1), (4, 8, 2, 4), (4, 8, 1, 8)],
)
def test_tasks_share_the_threads(tasks, threads, at_once, each):
    results = side_by_side([lambda n_threads, i=i: (i, n_threads) for i in range(tasks)], threads, at_once)
    assert results == [(i, each) for i in range(tasks)]


def model(states: int, *, steps: int = 800, particles: int = 84384):
    """Return the parts of a model that a gradient plan needs; its memory budget is a number of states."""
    layout = SimpleNamespace(n=particles, n_particles=particles, table=state_table(3))
    made = SimpleNamespace(n_steps=steps, dim=3, layout=layout, real=np.float64, substeps=4, memory_budget=0)
    made.state_bytes = state_table(3).n_rows * particles * np.dtype(np.float64).itemsize
    made.memory_budget = states * made.state_bytes
    return made


@pytest.mark.parametrize(
    ("states", "threads", "count"), [(132, 16, 16), (132, 12, 12), (132, 8, 8), (40, 4, 4), (33, 4, 9), (5, 2, 2)]
)
def test_gradients_at_once_finish_soonest(states, threads, count):
    """If as many run at once as fit, each has too little memory and runs its substeps up to 50 times."""
    models = [model(states)] * count
    chosen = gradients_at_once(models, threads)
    times = [-(-count // k) * gradient_time(models[0], k, threads) for k in range(1, min(threads, count) + 1)]
    assert times[chosen - 1] == pytest.approx(min(times)) or chosen == 1
    assert all(np.isinf(times)) == (states == 5)


def test_gradients_with_little_memory_wait_for_each_other():
    starving = model(132)
    assert gradient_time(starving, 13, 16) > 50
    assert 2 * gradient_time(starving, 8, 16) < 0.2 * 2 * gradient_time(starving, 13, 16)
    assert gradients_at_once([starving] * 16, 16) <= 8
    assert gradients_at_once([starving, model(10**4)] * 8, 16) <= 8


@pytest.mark.parametrize("particles", [100, 5000, 84384])
def test_every_thread_has_a_gradient_if_all_states_fit(particles):
    """Then more gradients at once are never slower."""
    for threads in range(1, 21):
        for count in range(1, 21):
            models = [model(20 * 801, particles=particles)] * count
            assert gradients_at_once(models, threads) == min(threads, count)
