"""Warnings about scenes, and the joint bound of cables in the same cell on the substep."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_finger import DESIGN, FINGER

from cqrun.build.model import build
from cqrun.scene.load import load_scene

CABLES = "\n".join(
    f"  {name}: {{cable: {{body: finger, route: [[{x}, 0.25], [{x}, 0.55]], stiffness: 1000}}}}"
    for name, x in (("one", 0.41), ("other", 0.44))
)
MUSCLE = "  muscle: {muscle: {body: finger, each: [left, right], axis: [0, 1], strength: 4}}"


def limit_of_cables(text: str) -> float:
    return min(limit.dt for limit in build(load_scene(text)).limits if "cable" in limit.part)


def test_cables_in_the_same_cell_bound_the_substep_together():
    both = FINGER.replace(MUSCLE, CABLES).replace("substeps: 2", "substeps: auto")
    alone = FINGER.replace(MUSCLE, CABLES.partition("\n")[0]).replace("substeps: 2", "substeps: auto")
    np.testing.assert_allclose(limit_of_cables(both), limit_of_cables(alone) / np.sqrt(2.0))


def test_a_tension_bounds_the_substep_by_its_shortest_segment():
    """A segment of length l turns back with the stiffness T / l."""

    def limit(cable: str) -> float:
        text = FINGER.replace(MUSCLE, f"  one: {{cable: {{body: finger, {cable}}}}}")
        return limit_of_cables(text.replace("substeps: 2", "substeps: auto"))

    straight, halfway = "route: [[0.41, 0.25], [0.41, 0.55]]", "route: [[0.41, 0.25], [0.41, 0.35], [0.41, 0.55]]"
    x = build(load_scene(FINGER)).particles.x
    tied = [x[np.argmin(((x - point) ** 2).sum(axis=1))] for point in ([0.41, 0.25], [0.41, 0.35], [0.41, 0.55])]
    first, whole = np.linalg.norm(tied[1] - tied[0]), np.linalg.norm(tied[2] - tied[0])
    stiff = limit(f"{straight}, stiffness: 1000")
    assert limit(f"{straight}, tension: 300") == pytest.approx(stiff * np.sqrt(1000 / (300 / whole)))
    assert limit(f"{halfway}, tension: 300") == pytest.approx(stiff * np.sqrt(1000 / (300 / first)))


def test_an_actuator_without_a_signal_does_nothing():
    """A cable is slack at 1 and reeled in at 0."""
    both = FINGER.replace(MUSCLE, f"{MUSCLE}\n{CABLES}")
    free = ["controller=null", "observers={}", "episodes=null"]
    for more, cables in (([], [1.0, 1.0]), (["activation={signals: {one: [0.5]}}"], [0.5, 1.0])):
        given = build(load_scene(both, [*free, *more])).assembly.actuation.activations(0, {})
        np.testing.assert_array_equal(given, np.tile([0.0, 0.0, *cables], (len(given), 1)))


def warnings_of(text: str) -> str:
    return "\n".join(str(warning) for warning in build(load_scene(text)).warnings)


def test_identical_episodes_are_a_warning():
    assert "episodes: has no effect" in warnings_of(FINGER.replace(", spread: [0.05, 0.05]", ""))
    assert "episodes: has no effect" not in warnings_of(FINGER)


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        (
            "at_most: 1.0e-8",
            "constraints.tip.at_most: 1e-08 counts as met when it is missed by 1e-06: the constraint_tolerance of "
            "1e-06 is in units of the constraint's `scale`, 1; with `scale: 1e-08` it would be 1e-14",
        ),
        ("at_most: 1.0e-8, scale: 1.0e-8", ""),
        ("at_most: 0, at_least: -1.0e-7", "constraints.tip.at_least: -1e-07 counts as met when it is missed by 1e-06"),
        ("equals: 0", ""),
        ("at_most: 0.018", ""),
    ],
)
def test_a_bound_below_the_tolerance_of_a_constraint_is_a_warning(bounds, message):
    """Squared lengths of a small robot are far below 1 in SI units, and the default scale is 1."""
    text = warnings_of(DESIGN.replace("at_most: 0.018, scale: 0.01", bounds))
    assert message in text
    assert ("counts as met" in text) == bool(message)


def test_the_constraints_of_shipped_scenes_are_larger_than_their_tolerance():
    for path in (Path(__file__).parents[2] / "scenes" / "codesign").glob("*.yaml"):
        scene = load_scene(path)
        tolerance = getattr(scene.optimizer.value, "constraint_tolerance", 0.0)
        assert not any(constraint.loose_end(tolerance) for constraint in scene.constraints.values())


SOFT = "bodies.soft.material.elastic.fixed_corotated"


def stable(modulus: float, ratio: float, *unknowns: str) -> float:
    """Return the largest stable substep of the finger and of another body, with the given modulus and ratio."""
    other = (
        "bodies.soft={shape: {box: {corner: [0.7, 0.2], size: [0.1, 0.1]}}, spacing: 0.05, material: {density: 1, "
        f"elastic: {{fixed_corotated: {{youngs_modulus: {modulus}, poissons_ratio: {ratio}}}}}}}}}"
    )
    free = f"unknowns={{{', '.join(f'{SOFT}.{unknown}' for unknown in unknowns)}}}"
    return min(limit.dt for limit in build(load_scene(FINGER, [other, free, "time.substeps=auto"])).limits)


def test_the_stiffest_corner_is_found_if_another_body_limits_the_substep_at_the_start():
    """The Poisson's ratio of the soft body has no effect there, but it has one at a larger modulus."""
    modulus, ratio = "youngs_modulus: {bounds: [1, 400]}", "poissons_ratio: {bounds: [0, 0.49]}"
    corner = stable(400, 0.49)
    assert corner < 0.5 * stable(400, 0.0) < 0.5 * stable(5, 0.3)
    assert stable(5, 0.3, modulus, ratio) == stable(5, 0.3, ratio, modulus) == corner


def test_the_stiffest_corner_is_found_if_a_product_is_zero_at_the_start():
    """A strength has no effect while its signal is zero."""
    signal, strength = "activation.signals.muscle.0", "actuators.muscle.muscle.strength"
    free = [
        "activation={signals: {muscle: [0]}}", "controller=null", "observers={}", "episodes=null",
        f"unknowns={{{strength}: {{bounds: [0, 4000]}}, {signal}: {{bounds: [0, 1]}}}}",
    ]  # fmt: skip
    fixed = ["activation={signals: {muscle: [1]}}", *free[1:4], f"{strength}=4000", "time.substeps=auto"]
    auto = [*free, "time.substeps=auto"]
    least = [min(limit.dt for limit in build(load_scene(FINGER, each)).limits) for each in (auto, fixed)]
    assert least[0] == least[1]


def test_far_too_many_substeps_are_a_warning():
    assert "of the largest stable one" in warnings_of(FINGER.replace("substeps: 2", "substeps: 100000"))
    assert "of the largest stable one" not in warnings_of(FINGER.replace("substeps: 2", "substeps: 20"))


def test_substeps_that_are_too_few_at_the_bounds_of_unknowns_are_a_warning():
    stiffness = "bodies.finger.material.elastic.fixed_corotated.youngs_modulus"
    stiffer = FINGER.replace("job: control", "job: codesign") + f"unknowns:\n  {stiffness}: {{bounds: [5, 4000]}}\n"
    least = min(limit.dt for limit in build(load_scene(stiffer)).limits)
    enough = int(np.ceil(load_scene(FINGER).time.control_step / least))
    few, many = (stiffer.replace("substeps: 2", f"substeps: {n}") for n in (enough - 1, enough))
    assert "at the unknowns' bounds" in warnings_of(few)
    assert "bodies.finger.material" in warnings_of(few)
    assert "at the unknowns' bounds" not in warnings_of(many)
    assert "at the unknowns' bounds" not in warnings_of(FINGER.replace("substeps: 2", f"substeps: {enough - 1}"))


def test_an_effort_that_rewards_pulling_cables_is_a_warning():
    """A cable has no effect at 1; counted from zero this is the largest effort, so the origin must be given."""
    slack = FINGER.replace(MUSCLE, f"{MUSCLE}\n{CABLES}")
    constrained = f"{slack}constraints:\n  weak: {{of: {{effort: {{}}}}, at_most: 1}}\n"
    text = warnings_of(slack)
    assert "objective.effort.effort.counted_from: counts from zero" in text
    assert "another activation (one: 1, other: 1): say `counted_from: neutral`" in text
    assert "constraints.weak.of.effort.counted_from: counts from zero" in warnings_of(constrained)
    for origin in ("zero", "neutral"):
        assert "counts from zero" not in warnings_of(slack.replace("weight: 1.0e-3", f"counted_from: {origin}"))
    assert "counts from zero" not in warnings_of(FINGER)


def test_a_sinusoid_too_fast_for_control_steps_is_a_warning():
    def warnings_at(frequency: float) -> str:
        scene = load_scene(FINGER, ["controller=null", f"controller={{sinusoid: {{frequency: {frequency}}}}}"])
        return "\n".join(map(str, build(scene).warnings))

    highest = 0.5 / load_scene(FINGER).time.control_step
    assert "controller.sinusoid.frequency" in warnings_at(1.01 * highest)
    assert "above" in warnings_at(1.01 * highest)
    assert "sinusoid" not in warnings_at(0.99 * highest)
