"""What is noted of deformations in the reference frame: too long a substep, inverted material, blow-ups."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from little_worlds import world

from cqrun.engine.frames import make_rollout
from cqrun.engine.model import GroupModel
from cqrun.engine.reference.remarks import LIMIT
from cqrun.engine.reference.stretch import LEAST, WATCH, watch_stretch
from cqrun.errors import RolloutError
from cqrun.materials.fixed_corotated import FixedCorotatedKernel
from cqrun.materials.neo_hookean import NeoHookeanKernel
from cqrun.materials.waves import wave_stiffness

E, NU, DENSITY, DX = 1e5, 0.3, 1000.0, 0.1
LAM, MU = E * NU / ((1 + NU) * (1 - 2 * NU)), E / (2 * (1 + NU))
FAST = float(np.sqrt((LAM + 2 * MU) / DENSITY))
LAWS = {"neo_hookean": NeoHookeanKernel, "fixed_corotated": FixedCorotatedKernel}


def block(controls=1, steps=96, dt=0.3 * DX / FAST, law="fixed_corotated", squeeze=12.0):
    """Return a free 2D block of 3 x 3 cells that is squeezed along x, and its inputs."""
    axis = 0.525 + 0.05 * np.arange(6)
    x = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    model, inputs = world(
        x, size=[2.0, 2.0], dx=DX, dt=dt, substeps=steps // controls, controls=controls,
        mass=DENSITY * 0.05**2, volume=0.05**2, E=E, nu=NU, probe=np.eye(len(x)),
    )  # fmt: skip
    kernel = LAWS[law]
    groups = (GroupModel((0,), (lambda theta: kernel(theta, (0, 0)),)),)
    model = replace(model, frame="reference", groups=groups, conditions=())
    inputs.coefficients = np.zeros(0)
    inputs.terms = [[np.tile(np.array([[E], [NU]]), len(x))]]
    inputs.state.v[:, 0] = -squeeze * (x[:, 0] - x[:, 0].mean())
    inputs.state.C[:, 0, 0] = -squeeze
    return model, inputs


def watched(F, law="fixed_corotated", substeps=6):
    """Return the remarks on a block whose particle 3 has the deformation gradient F, after 40 substeps."""
    model, inputs = block(law=law, steps=substeps, dt=0.6 * DX / FAST)
    rollout = make_rollout(model, inputs)
    run = rollout.bundle
    for k, entry in enumerate(np.eye(2).ravel()):
        run.q[:, 8 + k, :] = entry
    width = run.q.shape[2]
    for k, entry in enumerate(np.array(F, float).ravel()):
        run.q[3 // width, 8 + k, 3 % width] = entry
    watch_stretch(run, 0, run.stencils.f.shape[0], 40)
    return rollout.remarks()


@pytest.mark.parametrize("law", list(LAWS))
def test_the_stiffness_of_waves_at_rest_is_that_of_pressure_waves(law):
    theta = np.array([E, NU])
    for dim in (2, 3):
        stiffness = wave_stiffness([LAWS[law](theta[:, None], (0, 0))], [theta], np.eye(dim))
        assert stiffness == pytest.approx(LAM + 2 * MU, rel=2e-3)  # 3D: the directions are not dense


def test_the_stiffness_of_a_squeezed_and_of_a_stretched_body():
    """Along the axis s: mu + (mu + lam (1 - ln J)) / s^2 for neo-Hookean, 2 mu + lam L^2 for fixed corotated."""
    theta, s, L = np.array([E, NU]), 0.5, 2.0
    neo = wave_stiffness([NeoHookeanKernel(theta[:, None], (0, 0))], [theta], np.diag([s, 1.0]))
    assert neo == pytest.approx(MU + (MU + LAM * (1 - np.log(s))) / s**2, rel=1e-6)
    corotated = wave_stiffness([FixedCorotatedKernel(theta[:, None], (0, 0))], [theta], np.diag([s, L]))
    assert corotated == pytest.approx(2 * MU + LAM * L**2, rel=1e-6)


def test_deformations_are_noted_between_control_steps():
    """One control step or many: the same least stretch, though it is long over at the end of the only one."""
    found = []
    for controls in (1, 6):
        rollout = make_rollout(*block(controls=controls))
        rollout.run()
        found.append(rollout.bundle.least[LEAST, :3])
    np.testing.assert_allclose(found[0], found[1], rtol=1e-12)
    least, _, step = found[0]
    assert least < 0.9
    assert step % WATCH == 0
    assert step < 96


def test_a_squeezed_body_that_the_substep_is_too_long_for():
    (remark,) = watched(np.diag([0.25, 1.0]), "neo_hookean")
    when = 40 * 0.6 * DX / FAST
    assert remark.startswith(
        f"'body 0' was squeezed to 0.25 of its length at t = {when:.4g} s, where waves are so fast"
    )
    stiffness = MU + (MU + LAM * (1 - np.log(0.25))) / 0.25**2
    needed = int(np.ceil(6 * 0.6 * np.sqrt(stiffness / (LAM + 2 * MU)) / LIMIT))
    assert remark.endswith(f": set time.substeps={needed}")


@pytest.mark.parametrize(
    ("F", "law"), [([0.25, 1.0], "fixed_corotated"), ([0.6, 1.1], "neo_hookean"), ([0.72, 1.3], "neo_hookean")]
)
def test_a_substep_that_is_short_enough_is_not_reported(F, law):
    """Waves in a squeezed fixed corotated body are no faster; those of the automatic substep may be faster by half."""
    assert watched(np.diag(F), law) == []


def test_a_body_that_is_pulled_is_not_called_squeezed():
    (remark,) = watched(np.diag([3.0, 0.23]))
    assert remark.startswith("'body 0' was stretched to 3.00 times its length and thinned to 0.23 across at t = ")


def test_inverted_material_is_called_so():
    (remark,) = watched(np.diag([1.0, -1.02]))
    assert remark.startswith("'body 0' is inverted from t = ")
    assert "to a volume ratio of J = -1 at t = " in remark
    assert "squeezed" not in remark


def test_a_body_pulled_far_is_asked_about_tearing():
    remarks = watched(np.diag([6.0, 1.0]))
    assert remarks[-1].startswith("'body 0' was stretched to 6.00 times its length")
    assert remarks[-1].endswith("do not tear; if 'body 0' should, use `world.frame: updated`")


def test_a_run_that_blows_up_says_what_led_to_it():
    """It ends soon, though its only control step is long, and names the body and substeps to set."""
    model, inputs = block(steps=320, dt=1.1 * DX / FAST, law="neo_hookean", squeeze=25.0)
    with np.errstate(all="ignore"), pytest.raises(RolloutError) as error:  # without the compiler NumPy would warn
        make_rollout(model, inputs).run()
    assert error.value.time < 0.9 * 320 * model.dt
    assert "the simulation blew up: 'body 0' " in error.value.advice
    assert " time.substeps=" in error.value.advice
