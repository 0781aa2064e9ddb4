"""Threads that run side by side: they meet, are kept, hand errors on, and wait for nobody who never comes."""

from __future__ import annotations

import copy
import gc
import threading
import time

import pytest
from little_worlds import needs_jit

from cqrun.engine.team import Team
from cqrun.numerics.compile import barrier, kernel


@kernel
def meet(rounds, arrivals, thread, n_threads):
    """Come to so many barriers."""
    for _ in range(rounds):
        barrier(arrivals, n_threads)
    return thread


def others(team: Team) -> set[threading.Thread]:
    """Return the threads that a run takes, the caller's left out."""
    seen: list[threading.Thread] = []
    team.run(lambda thread: seen.append(threading.current_thread()))
    return set(seen) - {threading.current_thread()}


@needs_jit
@pytest.mark.parametrize("size", [1, 2, 3])
def test_all_take_part_and_the_answer_is_the_first_one_s(size):
    team, came = Team(size), []
    for rounds in (1, 0, 5):
        came.clear()

        def body(thread: int, rounds: int = rounds) -> int:
            came.append(thread)
            return int(meet(rounds, team.arrivals, thread, size))

        assert team.run(body) == 0
        assert sorted(came) == list(range(size))
    assert team.arrivals[0] == (6 * size if size > 1 else 0)


def test_threads_are_kept_and_end_with_their_team():
    team = Team(3)
    first = others(team)
    assert len(first) == 2
    assert others(team) == first
    del team
    gc.collect()
    for thread in first:
        thread.join(10.0)
        assert not thread.is_alive()


def test_a_child_without_its_parent_s_threads_starts_its_own():
    team = Team(2)
    first = others(team)
    team._process = -1  # as after a fork
    assert others(team).isdisjoint(first)


def test_a_copy_has_threads_of_its_own():
    team = Team(2)
    first = others(team)
    twin = copy.deepcopy(team)
    assert twin.size == 2
    assert others(twin).isdisjoint(first)


def test_what_another_thread_raises_is_raised():
    team = Team(2)

    def body(thread: int) -> None:
        if thread == 1:
            raise ValueError("of thread 1")

    with pytest.raises(ValueError, match="of thread 1"):
        team.run(body)
    assert team.run(lambda thread: thread) == 0


@needs_jit
def test_an_interrupt_leaves_nobody_at_a_barrier():
    team, left = Team(2), threading.Event()
    team.run(lambda thread: meet(1, team.arrivals, thread, 2))

    def body(thread: int) -> None:
        if thread == 0:
            time.sleep(0.05)
            raise KeyboardInterrupt
        meet(3, team.arrivals, thread, 2)
        left.set()

    with pytest.raises(KeyboardInterrupt):
        team.run(body)
    assert left.is_set()
    with pytest.raises(RuntimeError, match="interrupted"):
        team.run(lambda thread: None)
