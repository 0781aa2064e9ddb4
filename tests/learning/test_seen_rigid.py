"""Controllers that see a free rigid body and forces: gradients, ranges and the start, from scenes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from small_disc import DISC, SEEN

from cqrun.build.model import build
from cqrun.learning.agent import Agent
from cqrun.learning.episodes import EpisodeProblem
from cqrun.scene.load import load_scene

STEPS = 2.0 ** -np.arange(7, 14)


def agent_of(observers: dict[str, Any], **sections: Any) -> Agent:
    return Agent(build(load_scene({**DISC, "observers": observers, **sections})))


@pytest.mark.parametrize("name", SEEN)
def test_taylor_remainder_is_of_second_order(name, rng):
    """Through the controller, what it sees, actuators, contact and the free disc; by weights and by two unknowns."""
    problem = EpisodeProblem(agent_of(SEEN[name]), threads=1)
    x, way = problem.start, rng.normal(size=len(problem.start))
    loss, gradient = problem.value_and_grad(x)
    remainders = [abs(problem.value(x + h * way) - loss - h * gradient @ way) for h in STEPS]
    assert abs(gradient @ way) > 1e-3 * np.linalg.norm(gradient)
    assert np.log2(remainders[0] / remainders[-1]) / (len(STEPS) - 1) >= 1.9, remainders


def test_a_controller_sees_what_is_measured():
    """Motions are those of the moment; forces those of the control step before, and none at the start."""
    agent = agent_of({**{name: {"measured": {"quantity": name, "range": None}} for name in DISC["measure"]}})
    rollout = agent.rollout(agent.acting, {}, 1)
    records = rollout.run()
    found = agent.judged(rollout, records, {})
    seen = {name: found.observations[:, place] for name, place in agent.observation.parts.items()}
    motion, held = records.rigid["disc"][:-1], {name: rows[:-1] for name, rows in records.held.items()}
    for name, want in {
        "place": motion[:, :2], "turn": motion[:, 2:3], "speed": motion[:, 3:5], "push": held["disc"][:, :2],
        "weight": -held["floor"][:, :2], "tilt": held["floor"][:, 2:],
    }.items():  # fmt: skip
        np.testing.assert_array_equal(seen[name], want, err_msg=name)
        assert np.abs(want).max() > 0, name
    assert seen["speed"][0].tolist() == [0.0, -0.05]
    for name in ("push", "weight", "tilt", "pull"):
        np.testing.assert_allclose(seen[name][0], 0.0, atol=1e-12)
    assert seen["pull"].max() > 0


def test_ranges_fit_the_scene():
    """The size of the world, a half turn, the weight of the bodies, and a cable that is pulled in wholly."""
    agent = agent_of({name: {"measured": {"quantity": name}} for name in DISC["measure"]})
    half = {name: agent.observation.half[place] for name, place in agent.observation.parts.items()}
    weight = 9.80665 * 1000 * 0.12 * 0.04
    np.testing.assert_allclose(half["place"], [0.2, 0.14])
    np.testing.assert_allclose(half["speed"], [0.2, 0.14])
    np.testing.assert_allclose(half["turn"], np.pi)
    np.testing.assert_allclose(half["push"], weight)
    np.testing.assert_allclose(half["tilt"], weight * np.hypot(0.2, 0.14))
    np.testing.assert_allclose(2 * half["pull"], 500 * 0.1)
    rest = agent.observation.middle[agent.observation.parts["place"]]
    np.testing.assert_array_equal(rest, 0.0)
