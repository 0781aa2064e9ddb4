"""Measured quantities in cases with known answers, and what they refuse."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from made_matter import CONTROL_STEP, N_ACTUATORS, N_CONTROLS, made_matter

from cqrun.errors import CrushedError, UsageError
from cqrun.materials.viscosity import ViscosityKernel
from cqrun.measures import material
from cqrun.measures.measure import BoundMeasure
from cqrun.measures.turning import unwrapped
from cqrun.observers.track import Track
from cqrun.plugin.registry import plugins

TIMES = CONTROL_STEP * np.arange(N_CONTROLS + 1)
DIM = pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])


def bound(name: str, dim: int, **fields: Any) -> BoundMeasure:
    return plugins("measure")[name].model_validate(fields).bind(made_matter(dim))


def motion(measure: BoundMeasure, dim: int, at: Any, *, v: Any = None, activation: float = 0.0) -> Track:
    """Return a track in which every particle moves from its place at rest X to at(X, t), an affine map."""
    matter = made_matter(dim)
    x = np.array([at(matter.x, t) for t in TIMES])
    origin, axes = np.zeros(dim), np.eye(dim)
    F = np.array([(at(axes, t) - at(origin, t)).T for t in TIMES])  # its columns are the images of the axes
    velocity = np.zeros(x.shape) if v is None else np.broadcast_to(v, x.shape)
    rows = measure.rows
    gradients = np.array([rows @ np.broadcast_to(f, (len(matter.x), dim, dim)).reshape(len(matter.x), -1) for f in F])
    each = lambda field: np.array([rows @ frame for frame in field])  # noqa: E731
    none = np.zeros((*gradients.shape[:2], dim, dim))
    design = np.ones((4, len(matter.x)))
    held = {"clamp": np.ones((len(TIMES), 3 if dim == 2 else 6))}
    levels = np.full(N_ACTUATORS + 1, 3.0), np.full(N_ACTUATORS + 1, 0.25)
    return Track(
        each(x), each(velocity), none, gradients.reshape(none.shape),
        np.full((N_CONTROLS, N_ACTUATORS), activation), {}, CONTROL_STEP, design, held, *levels,
    )  # fmt: skip


def turn(angle: float, dim: int) -> np.ndarray:
    """Return the rotation from x to y by an angle."""
    R = np.eye(dim)
    R[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return R


@DIM
def test_a_point_of_the_material_moves_with_it(dim):
    point, pull = np.array([0.31, 0.28, 0.23][:dim]), np.diag([1.5, 0.8, 0.9][:dim])
    position = bound("position", dim, body="arm", point=point.tolist())
    track = motion(position, dim, lambda X, t: X @ pull.T + t)
    assert position.values(track) == pytest.approx(point @ pull.T + TIMES[:, None], abs=1e-12)
    moved = bound("displacement", dim, body="arm", point=point.tolist())
    assert moved.values(track) == pytest.approx(point @ pull.T - point + TIMES[:, None], abs=1e-12)


@DIM
def test_a_body_that_turns_several_times_has_counted_all_its_turns(dim):
    rotation = bound("rotation", dim, body="arm")
    rate = 2.5 / CONTROL_STEP  # 0.8 of half a turn in a control step, and more than two turns in all
    values = rotation.values(motion(rotation, dim, lambda X, t: X @ turn(rate * t, dim).T))
    about = np.array([1.0]) if dim == 2 else np.array([0.0, 0.0, 1.0])
    assert values == pytest.approx(rate * TIMES[:, None] * about, abs=1e-12)
    assert values.max() > 4 * np.pi


@DIM
def test_a_stretch_does_not_turn_a_body(dim):
    rotation = bound("rotation", dim, body="arm")
    pull = np.diag([1.7, 0.6, 1.1][:dim])
    values = rotation.values(motion(rotation, dim, lambda X, t: (X @ pull.T) @ turn(0.4, dim).T))
    expected = np.full((len(TIMES), 1), 0.4) if dim == 2 else np.tile([0.0, 0.0, 0.4], (len(TIMES), 1))
    assert values == pytest.approx(expected, abs=1e-12)


@DIM
def test_bend_is_the_turn_of_one_group_relative_to_another(dim):
    bend, x = bound("bend", dim, body="arm", group="left", to_group="tip"), made_matter(dim).x

    def bent(X: np.ndarray, t: float) -> np.ndarray:
        both = X @ turn(0.3, dim).T  # the whole body turns, which is no bending
        return np.where(X[..., :1] > 0.4, both @ turn(4.0 * t, dim).T, both)

    track = motion(bend, dim, lambda X, t: bent(X, t) if X.shape == x.shape else X)
    assert bend.values(track)[:, 0] == pytest.approx(4.0 * TIMES, abs=1e-12)


@DIM
def test_strain_and_stretch_of_a_uniform_stretch(dim):
    pull = np.diag([1.2, 0.9, 0.95][:dim])
    strain = bound("strain", dim, body="arm")
    track = motion(strain, dim, lambda X, t: (X @ pull.T) @ turn(t, dim).T)
    diagonal = 0.5 * (np.diag(pull) ** 2 - 1.0)
    expected = np.concatenate([diagonal, np.zeros(1 if dim == 2 else 3)])
    assert strain.values(track) == pytest.approx(np.tile(expected, (len(TIMES), 1)), abs=1e-12)
    along = bound("stretch", dim, body="arm", axis=[0.0, 3.0, 0.0][:dim])
    assert along.values(track) == pytest.approx(0.9, abs=1e-12)
    principal = bound("stretch", dim, body="arm")
    assert principal.values(track) == pytest.approx(np.tile(sorted(np.diag(pull))[::-1], (len(TIMES), 1)), abs=1e-12)


@DIM
def test_distance_energy_and_velocity_of_a_moving_body(dim):
    v = np.array([0.3, -0.4, 0.0][:dim])
    speed = bound("velocity", dim, body="ball")
    assert speed.values(motion(speed, dim, lambda X, t: X, v=v)) == pytest.approx(np.tile(v, (len(TIMES), 1)))
    energy = bound("kinetic_energy", dim, body="ball")
    n = len(made_matter(dim).members("ball"))
    assert energy.values(motion(energy, dim, lambda X, t: X, v=v)) == pytest.approx(0.5 * n * 0.25)
    gap = bound("distance", dim, body="arm", point=[0.3] * dim, position=[0.3, 0.1, 0.3][:dim])
    track = motion(gap, dim, lambda X, t: X + np.array([0.0, t, 0.0][:dim]))
    assert gap.values(track)[:, 0] == pytest.approx(0.2 + TIMES, abs=1e-12)


@DIM
def test_tension_is_that_of_the_law_of_the_cable(dim):
    matter = made_matter(dim)
    along = matter.x[[0, 3, 5, 1]]
    length = float(np.linalg.norm(np.diff(along, axis=0), axis=1).sum())
    route = bound("cable_length", dim, cable="cable")
    assert route.values(motion(route, dim, lambda X, t: X)) == pytest.approx(length)
    cable, weight = bound("cable_tension", dim, cable="cable"), bound("cable_tension", dim, cable="weight")
    still = lambda X, t: X  # noqa: E731
    taut = motion(cable, dim, still, activation=0.5)
    assert cable.values(taut) == pytest.approx(3.0 * (length - 0.5 * 0.25))
    assert cable.values(motion(cable, dim, still, activation=100.0)) == pytest.approx(0.0)
    assert weight.values(motion(weight, dim, still, activation=0.5)) == pytest.approx(1.5)
    spring = bound("cable_tension", dim, spring="spring")
    length = float(np.linalg.norm(np.diff(along[1:], axis=0), axis=1).sum())
    assert spring.values(motion(spring, dim, still)) == pytest.approx(3.0 * (length - 0.25))


def test_the_activation_of_a_moment_is_the_one_that_led_to_it():
    weight = bound("cable_tension", 2, cable="weight")
    track = motion(weight, 2, lambda X, t: X)
    track.activation[:, 2] = np.arange(N_CONTROLS)
    assert weight.values(track)[:, 0] == pytest.approx(3.0 * np.array([0, *range(N_CONTROLS)]))


@DIM
def test_a_reaction_has_no_value_at_the_start(dim):
    held = bound("reaction", dim, boundary="clamp", on="boundary")
    values = held.values(motion(held, dim, lambda X, t: X))
    assert np.isnan(values[0]).all()
    assert values[1:] == pytest.approx(-1.0)


@pytest.mark.parametrize(
    ("name", "fields", "message"),
    [
        ("position", {"body": "arm", "point": [0.9, 0.9]}, "not inside the body 'arm': its nearest particle, at"),
        ("position", {"body": "arm", "group": "hand"}, "no group of the body 'arm' called 'hand'"),
        ("distance", {"body": "arm", "to_group": "hand"}, "no group of the body 'arm' called 'hand'"),
        ("cable_length", {"cable": "muscle"}, "'muscle' is not a cable or a spring; there are: cable, weight, spring"),
    ],
)
def test_what_does_not_fit_the_scene_is_refused_with_what_would(name, fields, message):
    with pytest.raises(UsageError, match=message):
        bound(name, 2, **fields)


def test_a_part_without_extent_has_no_rotation():
    matter = made_matter(3)
    line = {"arm": {"line": np.flatnonzero((matter.x[:24, 1] < 0.25) & (matter.x[:24, 2] < 0.25))}, "ball": {}}
    matter = type(matter)(**{**vars(matter), "groups": line})
    spec = plugins("measure")["rotation"].model_validate({"body": "arm", "group": "line"})
    with pytest.raises(UsageError, match="on one line, so they have no rotation"):
        spec.bind(matter)


@pytest.mark.parametrize("axes", [1, 3])
def test_turns_are_counted_on_after_a_moment_without_a_rotation(axes):
    vectors = np.zeros((5, axes))
    vectors[:, -1] = [2.0, 3.0, np.nan, 3.9 - 2 * np.pi, 5.0 - 2 * np.pi]
    assert unwrapped(vectors)[:, -1] == pytest.approx([2.0, 3.0, np.nan, 3.9, 5.0], nan_ok=True)


def test_a_crushed_part_has_no_rotation():
    rotation = bound("rotation", 2, body="arm")
    with pytest.raises(CrushedError):
        rotation.values(motion(rotation, 2, lambda X, t: 0.0 * X))


@pytest.mark.parametrize(
    ("name", "fields", "message"),
    [
        ("position", {"body": "arm", "group": "tip", "point": [0.1, 0.1]}, "takes one of group, point, not both"),
        ("distance", {"body": "arm"}, "needs exactly one other place"),
        ("distance", {"body": "arm", "to": "ball", "position": [0.1, 0.1]}, "needs exactly one other place"),
        ("cable_length", {}, "needs one of `cable` and `spring`; has neither"),
        ("cable_tension", {"cable": "a", "spring": "b"}, "needs one of `cable` and `spring`; has both"),
    ],
)
def test_contradictions_are_refused(name, fields, message):
    with pytest.raises(ValueError, match=message):
        plugins("measure")[name].model_validate(fields)


def test_stress_and_energy_of_a_small_stretch_are_those_of_linear_elasticity():
    """In 3D: E eps along a stretch whose sides contract by nu eps, and E eps^2 / 2 per volume."""
    young, nu, eps = 2.0, 0.3, 1e-6
    pull = np.diag([1 + eps, 1 - nu * eps, 1 - nu * eps])
    for name, body, expected in (
        ("stress", "arm", [young * eps, 0, 0, 0, 0, 0]), ("stress", "ball", [young * eps, 0, 0, 0, 0, 0])
    ):  # fmt: skip
        stress = bound(name, 3, body=body)
        track = motion(stress, 3, lambda X, t: X @ pull)
        track.terms = uniform_terms(young, nu)
        assert stress.values(track)[-1] == pytest.approx(expected, rel=1e-5, abs=1e-5 * young * eps)
    matter = made_matter(3)
    for body in ("arm", "ball"):
        stored = bound("elastic_energy", 3, body=body)
        track = motion(stored, 3, lambda X, t: X @ pull)
        track.terms = uniform_terms(young, nu)
        volume = (track.design[1] / matter.room)[matter.members(body)].sum()
        assert stored.values(track)[-1, 0] == pytest.approx(0.5 * young * eps**2 * volume, rel=1e-3)


def uniform_terms(young: float, nu: float, dim: int = 3) -> list[list[np.ndarray]]:
    """Return the parameters of both bodies' terms: the first law's, and those of viscosity or incompressibility."""
    matter = made_matter(dim)
    counts = [len(matter.members(body)) for body in ("arm", "ball")]
    return [[np.tile([[young], [nu]], n), np.tile([[young], [nu]], n)] for n in counts]


@DIM
def test_a_shear_at_a_constant_rate_dissipates_at_a_constant_power(dim):
    """With d_xy = rate / 2 the power per volume is eta rate^2, and what it adds up to is exact."""
    rate, eta, L = 3.0, 0.4, np.zeros((dim, dim))
    L[0, 1] = rate
    lost, energy, volume = losing(dim, lambda t: np.eye(dim) + t * L, L, eta, 0.2)
    assert energy == pytest.approx(eta * rate**2 * volume * TIMES, rel=1e-12)
    assert lost.cumulative


@DIM
def test_a_growth_at_a_constant_rate_dissipates_by_both_viscosities(dim):
    """F = exp(a t) I, so J = exp(D a t); the power J (2 eta |dev d|^2 + zeta (D a)^2) grows with J.

    The trapezoidal rule takes (D a h)^2 / 12 too much for control steps h, as its theory says.
    """
    a, eta, zeta = 0.4, 0.4, 0.2
    _, energy, volume = losing(dim, lambda t: np.exp(a * t) * np.eye(dim), a * np.eye(dim), eta, zeta)
    shear = 2.0 * eta * (dim * a**2 - (dim * a) ** 2 / 3.0)  # of a 2D body in plane strain; zero in 3D
    exact = volume * (shear + zeta * (dim * a) ** 2) * (np.exp(dim * a * TIMES) - 1.0) / (dim * a)
    excess = (dim * a * CONTROL_STEP) ** 2 / 12.0
    assert energy == pytest.approx(exact * (1.0 + excess), rel=1e-3 * excess)


def test_a_turning_body_and_one_without_viscosity_dissipate_nothing():
    rate = 2.0
    _, energy, _ = losing(2, lambda t: turn(rate * t, 2), rate * np.array([[0.0, -1.0], [1.0, 0.0]]), 0.4, 0.2)
    assert energy == pytest.approx(np.zeros(len(TIMES)), abs=1e-12)
    lost = bound("dissipated_energy", 2, body="ball")  # elastic alone
    track = motion(lost, 2, lambda X, t: X @ np.diag([1.0 + t, 1.0]))
    track.C[:] = np.eye(2)
    track.terms = uniform_terms(2.0, 0.3, 2)
    assert not lost.values(track).any()


def losing(dim: int, F: Any, L: np.ndarray, eta: float, zeta: float) -> tuple[BoundMeasure, np.ndarray, float]:
    """Return the dissipated energy of the arm in a uniform motion F(t) with the velocity gradient L, and its volume."""
    lost, matter = bound("dissipated_energy", dim, body="arm"), made_matter(dim)
    track = motion(lost, dim, lambda X, t: X @ F(t).T)
    track.C[:] = L
    track.terms = uniform_terms(2.0, 0.3, dim)
    track.terms[0][1] = np.tile([[eta], [zeta]], len(matter.members("arm")))
    return lost, lost.values(track)[:, 0], float((track.design[1] / matter.room)[matter.members("arm")].sum())


def test_stress_turns_with_the_body():
    """The stress of a bar that is pulled along x and then turned by a right angle is along y."""
    stress = bound("stress", 2, body="ball")
    track = motion(stress, 2, lambda X, t: (X @ np.diag([1.1, 1.0])) @ turn(np.pi / 2, 2).T)
    track.terms = uniform_terms(2.0, 0.3, 2)
    xx, yy, xy = stress.values(track)[-1]
    assert yy > 2 * xx > 0
    assert xy == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("name", "meaning"),
    [
        ("stress", "Cauchy stress"),
        ("elastic_energy", "elastic energy"),
        ("dissipated_energy", "energy dissipated by viscosity"),
    ],
)
def test_what_depends_on_a_history_is_refused(name, meaning, monkeypatch):
    monkeypatch.setattr(material, "has_history", lambda kind: kind is ViscosityKernel)
    assert bound(name, 2, body="ball")
    with pytest.raises(UsageError, match=f"the {meaning} of a material with a history is not known: measure a strain"):
        bound(name, 2, body="arm")
