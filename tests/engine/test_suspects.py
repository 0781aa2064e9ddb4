"""A rollout that fails names the group, the actuator that swells or squeezes it, and what is turned inside out."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from cqrun.build.model import Built, build
from cqrun.engine.frames import make_rollout
from cqrun.engine.suspects import driver_at, place_of, suspect
from cqrun.errors import RolloutError
from cqrun.scene.load import load_scene
from cqrun.state import State

PARTS = {"skin": [0.06, 0.02], "filler": [0.08, 0.02], "other": [0.1, 0.02]}
SOFT = {"elastic": {"neo_hookean": {"youngs_modulus": 500, "poissons_ratio": 0.3}}}


@cache
def finger(frame: str = "updated") -> Built:
    """Return a finger whose soft filler is driven far beyond its stiffness."""
    parts = {name: {"box": {"corner": corner, "size": [0.02, 0.06]}} for name, corner in PARTS.items()}
    elastic = {"neo_hookean": {"youngs_modulus": 5e4, "poissons_ratio": 0.3}}
    scene = {
        "cqrun": 1,
        "world": {"size": [0.2, 0.2], "dx": 0.01, "gravity": [0, -9.81], "frame": frame},
        "bodies": {
            "finger": {
                "parts": parts,
                "particles_per_cell": 4,
                "groups": {"whole": {"box": {"corner": [0, 0], "size": [1, 1]}}},
                "material": {"density": 1000, "elastic": elastic},
                "material_of": {"filler": SOFT},
            }
        },
        "boundaries": {"base": {"sticky": {"region": {"box": {"corner": [0, 0], "size": [0.2, 0.03]}}}}},
        "actuators": {"pump": {"pneumatic": {"body": "finger", "region": "filler", "max_pressure": 2e4}}},
        "activation": {"signals": {"pump": [0, 1]}, "interpolate": "linear"},
        "time": {"duration": 0.5, "control_step": 0.005},
    }
    return build(load_scene(scene))


def failure(built: Built) -> RolloutError:
    with pytest.raises(RolloutError) as raised:
        make_rollout(built.model, built.assembly.inputs({})).run()
    return raised.value


def state_with(built: Built, **stretches: float) -> State:
    """Return the finger at rest, with some groups stretched alike along both axes."""
    state, groups = State.at_rest(built.particles.x), built.particles.groups("finger")
    for name, stretch in stretches.items():
        state.F[groups[name]] *= stretch
    return state


@pytest.mark.parametrize("frame", ["updated", "reference"])
def test_a_filler_that_swells_is_named_with_its_actuator(frame):
    error = failure(finger(frame))
    assert "the actuator 'pump' swells the group 'filler' of 'finger' to a volume ratio J of " in error.advice
    assert "weaken it, or make the material there stiffer" in error.advice
    assert "time.substeps" not in error.advice
    assert "smaller substeps" not in error.advice
    assert "do not tear" not in error.advice
    assert f"particle {error.particle} (group '{error.group}'), t = " in str(error)


def test_the_state_when_it_fails_shows_what_swelled():
    built = finger()
    assert suspect(built.model, state_with(built), np.ones(1)) == ""
    told = suspect(built.model, state_with(built, filler=2.0), np.array([0.25]))
    assert told.startswith("the actuator 'pump' swells the group 'filler' of 'finger' to a volume ratio J of 4 at an ")
    assert "at an activation of 0.25" in told
    assert suspect(built.model, state_with(built, filler=2.0), np.zeros(1)) == ""  # it does not act
    assert suspect(built.model, state_with(built, skin=2.0), np.ones(1)) == ""  # it acts elsewhere
    told = suspect(built.model, state_with(built, filler=0.5), np.ones(1))
    assert told.startswith("the actuator 'pump' squeezes the group 'filler' of 'finger' to a volume ratio J of 0.25 at")


def test_values_that_are_not_finite_and_single_wild_particles_do_not_count():
    built = finger()
    state, filler = state_with(built), built.particles.groups("finger")["filler"]
    state.F[filler[:5]] = np.nan
    state.F[filler[5]] *= 100.0
    assert suspect(built.model, state, np.ones(1)) == ""
    state = state_with(built, filler=1.2)
    state.F[filler[5]] *= 1000.0
    assert "a volume ratio J of more than 1000 at" in suspect(built.model, state, np.ones(1))


def test_material_that_is_turned_inside_out_is_named():
    built = finger()
    state, other = state_with(built), built.particles.groups("finger")["other"]
    state.F[other[:7], 0, 0] = -0.1
    told = suspect(built.model, state, np.zeros(1))
    assert told.startswith(f"7 of the {len(other)} particles of 'other' of 'finger' are turned inside out (J < 0)")


def test_a_particle_is_placed_in_its_smallest_group():
    built = finger()
    filler = built.particles.groups("finger")["filler"]
    assert place_of(built.model, int(filler[0])) == "'filler' of 'finger'"
    nameless = SimpleNamespace(body_names=built.model.body_names, layout=built.model.layout, regions={})
    assert place_of(nameless, int(filler[0])) == "'finger'"


def test_an_actuator_is_blamed_only_for_its_own_particles_when_it_acts():
    built = finger()
    groups = built.particles.groups("finger")
    inside, outside = int(groups["filler"][3]), int(groups["skin"][3])
    assert "swells" in driver_at(built.model, inside, 6.0, np.ones(1))
    assert "squeezes" in driver_at(built.model, inside, 0.1, np.ones(1))
    assert driver_at(built.model, inside, 1.5, np.ones(1)) == ""
    assert driver_at(built.model, inside, 6.0, np.zeros(1)) == ""
    assert driver_at(built.model, outside, 6.0, np.ones(1)) == ""


def test_a_body_that_is_thrown_out_of_the_grid_has_its_speed():
    """More than half a cell in a substep is too fast; a body that falls out is not."""
    built = finger()
    inputs = built.assembly.inputs({})
    inputs.activation[:] = 0.0
    inputs.state.v[:, 0] = 0.8 * built.model.dx / built.model.dt
    with pytest.raises(RolloutError, match=r"left the grid at .* m, at [\d.]+ m/s, which is [\d.]+ cells in a substep"):
        make_rollout(built.model, inputs).run()
