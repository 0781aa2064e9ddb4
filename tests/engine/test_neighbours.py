"""Which facets of other bodies are near a point: the spatial hash against a search through all of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cqrun.build.model import build
from cqrun.engine.frames import make_rollout
from cqrun.engine.reference.facet import nearest_on
from cqrun.engine.reference.neighbours import watch_pairs
from cqrun.engine.setting import Crew
from cqrun.scene.load import load_scene

DX = 0.05
MATERIAL = {"density": 1.0, "elastic": {"neo_hookean": {"youngs_modulus": 1.0, "poissons_ratio": 0.3}}}


def rollout_of(dim: int) -> Any:
    """Return a rollout of three balls that nearly touch in a row, and a block across them."""
    own: dict[str, Any] = {"particles_per_cell": 2**dim, "material": MATERIAL}
    centres = [[0.3 + 0.31 * k] + [0.4] * (dim - 1) for k in range(3)]
    bodies = {f"ball_{k}": own | {"shape": {"ball": {"center": c, "radius": 0.15}}} for k, c in enumerate(centres)}
    bodies["block"] = own | {
        "shape": {"box": {"corner": [0.2] + [0.4] * (dim - 2) + [0.56], "size": [0.8] + [0.1] * (dim - 2) + [0.2]}},
    }
    scene = {"cqrun": 1, "world": {"size": [1.2] * dim, "dx": DX, "frame": "reference"}, "bodies": bodies,
             "time": {"duration": 0.1, "control_step": 0.1}}  # fmt: skip
    built = build(load_scene(scene))
    return make_rollout(built.model, built.assembly.inputs({}))


@pytest.mark.parametrize("dim", [2, 3])
def test_the_hash_finds_all_facets_within_reach(dim, rng):
    """At rest, and after a random motion of the nodes, which stretches facets; the nearest come first."""
    rollout = rollout_of(dim)
    (meeting,), run = rollout.contacts.bodies, rollout.bundle
    pairs, facets = meeting.pairs, meeting.facets
    for size in (0.0, 0.3):
        u = np.zeros(rollout.start[0].shape)
        u[:, :dim] = size * DX * rng.normal(size=(len(u), dim))
        pairs.mark[:] = np.inf
        assert watch_pairs(meeting, run, u, Crew(0, 1))
        counts = []
        for s in range(0, len(facets.body), 7 if dim == 3 else 1):
            x, found = meeting.x[s], []
            for f in range(len(facets.corner)):
                if facets.body[facets.corner[f, 0]] != facets.body[s]:
                    square = nearest_on(facets.corner, f, tuple(x), meeting.x)[1]
                    if square < pairs.margin**2:
                        found.append((square, f))
            found.sort()
            many = pairs.many[s]
            counts.append(len(found))
            assert many == min(len(found), pairs.facets.shape[1])
            np.testing.assert_array_equal(pairs.square[s, :many], [square for square, _ in found[:many]])
            assert {int(f) for f in pairs.facets[s, :many]} <= {
                f for square, f in found if square <= found[many - 1][0]
            }
        assert max(counts) > 3


@pytest.mark.parametrize("dim", [2, 3])
def test_lists_are_found_again_before_an_unknown_facet_can_be_near(dim):
    """A motion of all nodes of a body by less than `reach` keeps them; a longer one does not."""
    rollout = rollout_of(dim)
    (meeting,), run = rollout.contacts.bodies, rollout.bundle
    u = np.zeros(rollout.start[0].shape)
    assert watch_pairs(meeting, run, u, Crew(0, 1))
    reach = meeting.pairs.reach
    own = run.nodes.active[run.nodes.active < rollout.rest.patches.begin[1]]
    u[own, 0] = 0.99 * reach
    assert not watch_pairs(meeting, run, u, Crew(0, 1))
    u[own, 0] = 1.01 * reach
    assert watch_pairs(meeting, run, u, Crew(0, 1))
    assert not watch_pairs(meeting, run, u, Crew(0, 1))
    largest = np.abs(meeting.surface.points.weight).sum(axis=1).max()
    assert 2 * reach * largest <= 0.5 * meeting.pairs.margin * (1 + 1e-12)
