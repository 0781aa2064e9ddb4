"""The papers' PPO, killed and started again, gives the same result (extra `rl`; `make test-rl`)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.papers.families import train_ppo as training
from cqrun.store.atomic import write_bytes

pytestmark = pytest.mark.rl
SCENE = Path("scenes/control/finger_random.yaml")
SMALL = ["bodies.finger.sampling.lattice.count=8", "time.duration=0.05"]


class Killed(Exception):
    pass


@pytest.fixture
def explosive(monkeypatch):
    """Robots that blow up in the third step, where the goal lies to the right."""
    from cqrun.learning.environment import SceneEnvironment  # of the extra rl

    step = SceneEnvironment.step

    def explode(self, action):
        if self.control != 2 or np.ravel(self.goals["target"])[0] < 0.5:
            return step(self, action)
        self.over = True
        return self.seen, self._reward_of_a_blow_up(), True, False, {"failed": "blew up", "loss": self.loss}

    monkeypatch.setattr(SceneEnvironment, "step", explode)


@pytest.mark.parametrize("after", [1, 2])
def test_killed_and_started_again_it_finds_the_same(tmp_path, monkeypatch, after):
    finds_the_same(tmp_path, monkeypatch, after)


@pytest.mark.parametrize("after", [1, 2])
def test_an_episode_that_was_cut_short_does_not_end_checkpoints(tmp_path, monkeypatch, explosive, after):
    """The next episodes begin between two updates of the networks, and once had no checkpoints."""
    finds_the_same(tmp_path, monkeypatch, after)


def finds_the_same(tmp_path, monkeypatch, after):
    whole = training.train_ppo(SCENE, SMALL, 40, 3, tmp_path / "whole.checkpoint")
    written = []

    def write(file, data):
        write_bytes(file, data)
        written.append(file)
        if len(written) == after:
            raise Killed

    checkpoint = tmp_path / "half.checkpoint"
    monkeypatch.setattr(training, "write_bytes", write)
    with pytest.raises(Killed):
        training.train_ppo(SCENE, SMALL, 40, 3, checkpoint)
    assert 0 < training.episodes_in(checkpoint) < 40
    assert training.train_ppo(SCENE, SMALL, 40, 3, checkpoint) == whole
    assert len(whole) == 40
