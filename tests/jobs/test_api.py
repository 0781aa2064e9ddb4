"""`cqrun.load`: a scene as a function, NumPy in and out."""

from __future__ import annotations

import numpy as np
import pytest
from small_beam import BEAM, E_PATH, FIT, SHEAR_PATH, changed, record, recorded, result_of

import cqrun
from cqrun.errors import RolloutError, SceneError, UsageError
from cqrun.jobs.simulate import run_simulate
from cqrun.jobs.sysid import run_sysid
from cqrun.store.history import read_history
from cqrun.store.trajectory import read_trajectory

DENSITY = "bodies.beam.material.density"


@pytest.fixture(scope="module")
def problem():
    return cqrun.load(BEAM + FIT, threads=1)


def test_params_are_the_unknowns_at_their_starts(problem):
    assert problem.params == {E_PATH: 3.0e4, SHEAR_PATH: 3.0}
    assert problem.scene.time.duration == 0.1


def test_the_loss_is_that_of_sysid(problem, fit, tmp_path):
    loss, gradient, aux = problem.value_and_grad()
    run = run_sysid(fit, ["optimizer={lbfgs: {max_iterations: 1}}"], tmp_path, threads=1)
    history = read_history(run / "history.csv")
    assert loss == pytest.approx(history["loss"][0], rel=1e-12)
    assert aux["losses"] == {"synthetic": loss}
    assert aux["gradient"]["recompute_factor"] == 1.0
    width = np.log(10.0)  # of the bounds of E, in its logarithm
    assert abs(gradient[E_PATH]) * 3.0e4 * width == pytest.approx(history[f"grad:{E_PATH}"][0], rel=1e-9)


@pytest.mark.parametrize(
    ("path", "value", "step"), [(E_PATH, 3.5e4, 3.0), (DENSITY, 900.0, 0.05), ("world.gravity.1", -9.0, 1e-3)]
)
def test_gradients_are_those_of_differences(problem, path, value, step):
    """Also by numbers that are no unknowns."""
    loss, gradient, _ = problem.value_and_grad({path: value})
    assert gradient.keys() == {E_PATH, SHEAR_PATH, path}
    assert isinstance(gradient[path], float)
    ahead, behind = (problem.value_and_grad({path: value + sign * step})[0] for sign in (1, -1))
    assert gradient[path] == pytest.approx((ahead - behind) / (2 * step), rel=1e-5)
    assert problem.value_and_grad({path: value})[0] == loss  # and the call leaves nothing behind


def test_a_number_for_every_particle(problem, rng):
    values = 3.0e4 * rng.uniform(0.9, 1.1, 40)
    _, gradient, _ = problem.value_and_grad({E_PATH: values})
    assert gradient[E_PATH].shape == (40,)
    direction = rng.normal(size=40)
    ahead, behind = (problem.value_and_grad({E_PATH: values + sign * direction})[0] for sign in (1, -1))
    assert gradient[E_PATH] @ direction == pytest.approx((ahead - behind) / 2, rel=1e-5)


def test_a_number_for_every_group(problem):
    """The only group is a part of the body: its value says nothing of the rest."""
    loss, gradient, _ = problem.value_and_grad({E_PATH: np.array([4.0e4])})
    inside = problem.built.particles.x[:, 0] <= 0.07
    values = np.where(inside, 4.0e4, 3.0e4)
    same, by_particle, _ = problem.value_and_grad({E_PATH: values})
    assert loss == same
    assert gradient[E_PATH].shape == (1,)
    assert gradient[E_PATH][0] == pytest.approx(by_particle[E_PATH][inside].sum(), rel=1e-12)


def test_unknowns_by_particle_are_arrays(fit):
    changed(fit, "scale: log}\n  bodies.beam.material.visc", "scale: log, per: particle}\n  bodies.beam.material.visc")
    problem = cqrun.load(fit)
    np.testing.assert_array_equal(problem.params[E_PATH], np.full(40, 3.0e4))
    assert problem.value_and_grad()[1][E_PATH].shape == (40,)


def test_simulate_is_the_job(problem, fit, tmp_path):
    motion = problem.simulate()
    expected = read_trajectory(run_simulate(fit, [], tmp_path, threads=1) / "trajectory.h5")
    np.testing.assert_array_equal(motion.x, expected.fields["x"])
    np.testing.assert_allclose(motion.v, expected.fields["v"], rtol=1e-6, atol=1e-12)  # float32 on disk
    np.testing.assert_array_equal(motion.time, expected.time)
    assert motion.bodies == expected.bodies == {"beam": slice(0, 40)}


def test_simulate_takes_values(problem):
    rest = problem.simulate({"world.gravity.1": 0.0})
    np.testing.assert_allclose(rest.x, np.broadcast_to(rest.x[0], rest.x.shape), rtol=0, atol=1e-15)


def test_overrides_are_those_of_the_command_line(fit):
    assert cqrun.load(fit, ["time.duration=0.03"]).simulate().x.shape == (4, 40, 2)
    with pytest.raises(SceneError, match=r"-o time.duraton=1: time.duraton: .*did you mean 'duration'"):
        cqrun.load(fit, ["time.duraton=1"])


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"bodies.beam.material.densty": 1.0}, "'bodies.beam.material' has no 'densty' .*did you mean"),
        ({"world.dx": 0.1}, r"world.dx: no gradient reaches it"),
        ({"world.gravity": 1.0}, r"world.gravity: is not a number but contains others"),
        ({E_PATH: np.ones(39)}, r"a value of shape \(39,\); it must be one of \(\), \(40,\), \(1,\)"),
        ({"world.gravity.1": np.ones(2)}, r"a value of shape \(2,\); it must be one of \(\)"),
        ({DENSITY: float("nan")}, r"density: must be finite, is nan"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(problem, params, message):
    with pytest.raises(UsageError, match=message):
        problem.value_and_grad(params)


def test_a_scene_without_data_has_no_loss():
    problem = cqrun.load(BEAM)
    assert problem.params == {}
    with pytest.raises(UsageError, match="this scene has neither `data` nor an `objective`"):
        problem.value_and_grad()


def test_values_that_blow_up_are_told(problem):
    with pytest.raises(RolloutError, match="body 'beam'"):
        problem.simulate({E_PATH: 1e9})


def test_values_for_which_the_chosen_substep_is_too_large():
    """`auto` chose it for the scene's own; the number that the message names is enough."""
    chosen = cqrun.load(BEAM, ["time.substeps=auto", "time.duration=0.03"], threads=1)
    told = r"bodies.beam.material: with these values the largest stable substep is .* load it with time.substeps=35,"
    with pytest.raises(UsageError, match=told):
        chosen.simulate({E_PATH: 3e5})
    with pytest.raises(UsageError, match=r"bodies.beam.material: asks for substeps of"):
        chosen.simulate({E_PATH: 1e30})
    given = cqrun.load(BEAM, ["time.substeps=35", "time.duration=0.03"], threads=1)
    expected = cqrun.load(BEAM, ["time.substeps=70", "time.duration=0.03"], threads=1).simulate({E_PATH: 3e5}).x
    np.testing.assert_allclose(given.simulate({E_PATH: 3e5}).x, expected, rtol=0, atol=1e-4)
    assert np.ptp(chosen.simulate({E_PATH: 9e4}).x) < 1.0, "beyond the share of `auto`, within the limit"


def test_values_that_a_scene_would_refuse(problem):
    """Of arrays the least and the greatest."""
    with pytest.raises(UsageError, match=r"density: must be greater than 0, is -1"):
        problem.value_and_grad({DENSITY: -1.0})
    count = len(problem.built.particles.x)
    with pytest.raises(UsageError, match=r"density: must be greater than 0, is -1"):
        problem.simulate({DENSITY: np.linspace(-1.0, 1.0, count)})
    with pytest.raises(UsageError, match=r"poissons_ratio: must be less than 0\.5, is 0\.5"):
        problem.simulate({"bodies.beam.material.elastic.fixed_corotated.poissons_ratio": 0.5})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((None,), "the scene must be a file's path, YAML text or a dict, is empty"),
        ((BEAM, "time.duration=1"), r"overrides are a list: \['time.duration=1'\]"),
        ((BEAM, [("world.dx", 0.01)]), r"overrides are a list of texts 'key.path=value', not \[\('world.dx', 0.01\)\]"),
        ((BEAM, {"world.dx": 0.01}), "overrides are a list of texts 'key.path=value', not a mapping"),
    ],
)
def test_arguments_that_cannot_be(arguments, message):
    with pytest.raises(UsageError, match=message):
        cqrun.load(*arguments)


def test_threads_and_params_that_cannot_be(problem):
    for threads in (0, "2", True):
        with pytest.raises(UsageError, match="threads must be a whole number from 1 on"):
            cqrun.load(BEAM, threads=threads)
    assert cqrun.load(BEAM, threads=np.int64(1)).threads == 1
    with pytest.raises(UsageError, match="params must be a mapping from key paths to values"):
        problem.simulate([1.0])
    with pytest.raises(UsageError, match="density: must be a number or an array of numbers, is 'heavy'"):
        problem.simulate({DENSITY: "heavy"})
    with pytest.raises(UsageError, match=r"params: a key path is text, such as 'world.gravity.1', not 1"):
        problem.simulate({1: 2})
    with pytest.raises(UsageError, match="goals must be a mapping from goals to their entries, is "):
        problem.simulate(goals=[1])


def test_a_run_is_loaded_with_what_it_found(fit, tmp_path):
    """Its scene as it was at the start, its files from where it began; and the values at its end."""
    run = run_sysid(record_and_fit(fit), [], tmp_path / "out", threads=1)
    problem = cqrun.load(run, threads=1)
    assert problem.params == {E_PATH: 3.0e4, SHEAR_PATH: 3.0}
    result = result_of(run)
    assert problem.found == {path: entry["value"] for path, entry in result["unknowns"].items()}
    loss, _, _ = problem.value_and_grad(problem.found)
    assert loss == pytest.approx(result["loss"], rel=1e-12)
    assert loss < 0.1 * problem.value_and_grad()[0]
    motion = cqrun.load(str(run), threads=1).simulate(problem.found)
    np.testing.assert_array_equal(motion.x, read_trajectory(run / "trajectory.h5").fields["x"])


def record_and_fit(scene):
    """Return the scene, fitted to a recording beside it that it names by itself alone."""
    (file,) = record(scene, scene.parent / "files")
    return recorded(scene, {"first": file.relative_to(scene.parent)})


def test_a_start_from_which_the_run_does_not_reach_the_last_frame(fit):
    scene = record_and_fit(fit)
    problem = cqrun.load(scene, ["data.recordings.first.start=0.02", "data.recordings.first.length=0.08"], threads=1)
    assert problem.value_and_grad({"data.recordings.first.start": 0.03})[0] != problem.value_and_grad()[0]
    with pytest.raises(
        UsageError, match=r"recordings.first.start: must be 0.02 s or later, is 0.018 s: .* up to 0.1 s"
    ):
        problem.value_and_grad({"data.recordings.first.start": 0.018})


def test_what_a_run_has_not_found(problem, beam, tmp_path):
    with pytest.raises(UsageError, match="found: this scene has no run; load a run directory"):
        _ = problem.found
    run = run_simulate(beam, ["time.duration=0.01"], tmp_path / "out", threads=1)
    with pytest.raises(UsageError, match=r"found nothing \(a run of simulate, done\)"):
        _ = cqrun.load(run).found
    with pytest.raises(UsageError, match=r"no run \(it has no run.json\)"):
        cqrun.load(tmp_path)


TIED = f"unknowns.{SHEAR_PATH}={{bounds: [0.5, 20], also: {{{DENSITY}: {{factor: 100, offset: 700}}}}}}"


def test_what_follows_an_unknown_follows_here_too():
    """An unknown's gradient has that of what follows it, unless that is given a value of its own; so has the truth."""
    true_too = f"data.synthetic.truth.{DENSITY}=1300"
    together, apart = cqrun.load(BEAM + FIT, [TIED], threads=1), cqrun.load(BEAM + FIT, [true_too], threads=1)
    loss, gradient, _ = together.value_and_grad()
    same, parts, _ = apart.value_and_grad({DENSITY: 1000.0})
    assert loss == same
    assert gradient[SHEAR_PATH] == pytest.approx(parts[SHEAR_PATH] + 100 * parts[DENSITY], rel=1e-12)
    assert set(gradient) == {E_PATH, SHEAR_PATH}
    _, given, _ = together.value_and_grad({DENSITY: 1000.0})
    assert given[SHEAR_PATH] == pytest.approx(parts[SHEAR_PATH], rel=1e-12)
    many = np.full(40, 3.0)
    with pytest.raises(UsageError, match=rf"shape \(40,\); it must be a number, for {DENSITY} to follow$"):
        together.value_and_grad({SHEAR_PATH: many})
    _, each, _ = together.value_and_grad({SHEAR_PATH: many, DENSITY: 1000.0})  # then nothing follows
    assert each[SHEAR_PATH].sum() == pytest.approx(given[SHEAR_PATH], rel=1e-12)


def test_a_number_stands_for_all_where_another_body_follows():
    twin = "bodies.twin={shape: {box: {corner: [0.02, 0.08], size: [0.1, 0.01]}}, particles_per_cell: 4, material: "
    twin += "{density: 1000, elastic: {fixed_corotated: {youngs_modulus: 3.0e4, poissons_ratio: 0.3}}, "
    twin += "viscosity: {shear: 3}}}"
    other = E_PATH.replace("beam", "twin")
    both = cqrun.load(
        BEAM + FIT, [twin, f"unknowns.{E_PATH}={{bounds: [1e4, 1e5], per: particle, also: [{other}]}}"], threads=1
    )
    loss, gradient, _ = both.value_and_grad({E_PATH: 3.5e4})
    same, by_particle, _ = both.value_and_grad({E_PATH: np.full(40, 3.5e4)})
    assert (loss, gradient[E_PATH].shape) == (same, (40,))
    np.testing.assert_array_equal(gradient[E_PATH], by_particle[E_PATH])
    assert both.stable_values({E_PATH: 3.5e4, other: 3.0e4})[other] == 3.0e4


def test_a_wanted_place_means_the_same_centroid_whatever_its_particles_weigh():
    """A value that is tried gives the loss of a scene that says it."""
    root = "bodies.beam.material_of.root.density"
    there = "objective={there: {track: {body: beam, keys: [[0.1, 0.07, 0.05]]}}}"
    first, second = (
        cqrun.load(BEAM, [there, f"bodies.beam.material_of={{root: {{density: {n}}}}}"], threads=1)
        for n in (1500, 3000)
    )
    tried, gradient, _ = first.value_and_grad({root: 3000.0})
    said, own, _ = second.value_and_grad({root: 3000.0})
    assert (tried, gradient) == (said, own)
