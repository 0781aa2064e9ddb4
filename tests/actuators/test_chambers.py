"""Chambers: walls and forces, adjoints in motion and at equilibrium, what is measured, and what is refused."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from little_worlds import needs_jit

from cqrun.actuators.chamber import Chamber, ChamberKernel, swell, swell_vjp
from cqrun.actuators.closed_chamber import ClosedKernel, swell_closed, swell_closed_vjp
from cqrun.actuators.surface_pressure import PatchKernel, SurfacePressure, weigh_jvp
from cqrun.build.model import build
from cqrun.errors import SceneError
from cqrun.forces.force import Kind, Levels, Skin, make_forces
from cqrun.forces.wall import cavities, enclosed, enclosed_vjp, winding
from cqrun.geometry.skin import make_skin
from cqrun.jobs.gradcheck import run_gradcheck
from cqrun.jobs.simulate import run_simulate
from cqrun.numerics.packed import pack
from cqrun.scene.load import load_scene
from cqrun.store.trajectory import read_trajectory

DOT_PRODUCT = 1e-9
DIM = pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])
SUPPLIES = ("pressure", "gas", "liquid")
SUPPLY = pytest.mark.parametrize("supply", SUPPLIES)

# --- one wall -----------------------------------------------------------------------------------------------------


def hollow(dim: int, spacing: float) -> Skin:
    """Return the surface of a ball of radius 1 with a ball of radius 0.5 cut out."""
    skin = make_skin(
        lambda x: (np.linalg.norm(x, axis=1) < 1) & (np.linalg.norm(x, axis=1) > 0.5), -np.ones(dim), np.ones(dim),
        spacing,
    )  # fmt: skip
    return Skin(skin.x, np.arange(len(skin.x)), skin.facets)


@DIM
def test_the_cavity_of_a_hollow_ball(dim):
    skin = hollow(dim, 0.1)
    (wall,) = cavities(skin)
    exact = np.pi * 0.25 if dim == 2 else np.pi / 6
    assert enclosed(skin.x, wall) == pytest.approx(exact, rel=0.03)
    assert winding(skin.x, wall, np.full(dim, 0.1)) == pytest.approx(1.0)
    assert winding(skin.x, wall, np.full(dim, 0.45)) == pytest.approx(0.0, abs=1e-9)


@DIM
def test_the_gradient_of_the_volume(dim, rng):
    skin = hollow(dim, 0.25)
    (wall,) = cavities(skin)
    x = skin.x + 0.05 * rng.normal(size=(2, *skin.x.shape))
    change, bar = rng.normal(size=x.shape), rng.normal(size=2)
    h = 1e-3  # the volume is a polynomial of third order: this stencil of five points is exact
    slope = sum(w * enclosed(x + k * h * change, wall) for k, w in ((-2, 1), (-1, -8), (1, 8), (2, -1))) / (12 * h)
    assert (enclosed_vjp(x, wall, bar) * change).sum() == pytest.approx((slope * bar).sum(), rel=DOT_PRODUCT)


def packed(rows: np.ndarray) -> np.ndarray:
    """Return a packed table of the rows (n, k) of points."""
    return pack(np.pad(rows, ((0, -len(rows) % 16), (0, 0))).T, np.float64)


class Forces:
    """The forces of one chamber on its points, or those of a patch of the surface, as kernels compute them."""

    def __init__(self, dim: int, supply: str) -> None:
        skin = hollow(dim, 0.25)
        skin = skin._replace(pick=lambda region, x, particle: x[:, 0] > 0.1)
        spec: Any = Chamber(body="b", **{supply: 0.3}, ambient=2.0, bulk_modulus=1.5) if supply in SUPPLIES else None
        if spec is None:
            spec = SurfacePressure(
                body="b", region={"half_space": {"point": [0] * dim, "normal": [1] * dim}}, pressure=1
            )
        riding = spec.riding("", lambda: skin)
        self.x, self.points = riding.x, np.arange(len(riding.x))
        kinds = [Kind(spec.kernel, np.zeros(1, np.int64), [self.points], [riding.constants])]
        (self.kernel,), self.shares = make_forces(kinds, dim)
        self.exert, self.exert_vjp = {
            ClosedKernel: (swell_closed, swell_closed_vjp), ChamberKernel: (swell, swell_vjp),
            PatchKernel: (swell, swell_vjp),
        }[spec.kernel]  # fmt: skip
        self.rest = spec.rest_size(riding.x, riding.constants)

    def levels(self, numbers: np.ndarray) -> Levels:
        """Return levels of an activation, a strength and a rest volume."""
        return Levels(np.array([[numbers[0]]]), numbers[1:2].copy(), numbers[2:3].copy(), np.zeros(1))

    def on_points(self, x: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """Return the forces (n, D)."""
        q = packed(np.concatenate([x, 0 * x], axis=1))
        for item in range(len(self.kernel.parts)):
            self.exert(self.kernel, item, self.levels(numbers), 0, q)
        out = np.zeros(x.shape)
        np.add.at(out, self.shares.columns, self.shares.force)
        return out

    def vjp(self, x: np.ndarray, numbers: np.ndarray, bar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the cotangents of positions and of the three numbers."""
        q = packed(np.concatenate([x, 0 * x], axis=1))
        push_bar = packed(bar)
        for item in range(len(self.kernel.parts)):
            self.exert_vjp(self.kernel, item, self.levels(numbers), 0, q, push_bar)
        out = np.zeros(x.shape)
        np.add.at(out, self.shares.columns, self.shares.x_bar)
        return out, self.shares.level_bar.sum(axis=0)

    def jvp(self, x: np.ndarray, numbers: np.ndarray, move: np.ndarray) -> np.ndarray:
        """Return how the forces (n, D) of a patch change with a displacement."""
        q = packed(np.concatenate([x, 0 * x], axis=1))
        for item in range(len(self.kernel.parts)):
            weigh_jvp(self.kernel, item, self.levels(numbers), 0, q, packed(move))
        out = np.zeros(x.shape)
        np.add.at(out, self.shares.columns, self.shares.x_bar)
        return out


@needs_jit
@DIM
@SUPPLY
def test_forces_of_a_chamber(dim, supply, rng):
    """Their adjoint; their tangent is symmetric; they have neither a resultant nor a moment, and are p dV/dx."""
    forces = Forces(dim, supply)
    x = forces.x + 0.03 * rng.normal(size=forces.x.shape)
    numbers = np.array([0.7, 0.3, forces.rest])
    f = forces.on_points(x, numbers)
    assert np.abs(f.sum(axis=0)).max() < 1e-13
    moment = x[:, :1] * f[:, 1:2] - x[:, 1:2] * f[:, :1]
    assert abs(moment.sum()) < 1e-13
    changes = rng.normal(size=(2, *x.shape))
    bar = rng.normal(size=x.shape)
    x_bar, number_bar = forces.vjp(x, numbers, bar)

    def slope(x_change: np.ndarray, number_change: np.ndarray) -> np.ndarray:
        h, points = 2e-3, ((-3, -1), (-2, 9), (-1, -45), (1, 45), (2, -9), (3, 1))
        return sum(w * forces.on_points(x + k * h * x_change, numbers + k * h * number_change) for k, w in points) / (
            60 * h
        )

    still = np.zeros(x.shape)
    assert (x_bar * changes[0]).sum() == pytest.approx((bar * slope(changes[0], np.zeros(3))).sum(), rel=DOT_PRODUCT)
    for k in range(3):
        expected = (bar * slope(still, np.eye(3)[k])).sum()
        assert number_bar[k] == pytest.approx(expected, rel=DOT_PRODUCT, abs=1e-11)
    one, other = (forces.vjp(x, numbers, change)[0] for change in changes)
    assert (one * changes[1]).sum() == pytest.approx((other * changes[0]).sum(), rel=1e-12)


@needs_jit
@DIM
def test_forces_on_a_patch(dim, rng):
    """Its adjoint, and the product of its tangent, which is not symmetric: the rim is free."""
    forces = Forces(dim, "patch")
    x = forces.x + 0.03 * rng.normal(size=forces.x.shape)
    numbers, bar = np.array([0.7, 0.3, 0.0]), rng.normal(size=x.shape)
    moves = rng.normal(size=(2, *x.shape))
    x_bar, number_bar = forces.vjp(x, numbers, bar)
    h = 1e-2  # the forces are polynomials of second order: central differences are exact
    slopes = [(forces.on_points(x + h * m, numbers) - forces.on_points(x - h * m, numbers)) / (2 * h) for m in moves]
    assert (x_bar * moves[0]).sum() == pytest.approx((bar * slopes[0]).sum(), rel=DOT_PRODUCT)
    one = (bar * forces.on_points(x, numbers)).sum()
    assert number_bar[:2] == pytest.approx([one / 0.7, one / 0.3], rel=DOT_PRODUCT)
    for move, slope in zip(moves, slopes, strict=True):
        assert forces.jvp(x, numbers, move) == pytest.approx(slope, rel=1e-9, abs=1e-12)
    assert abs((moves[1] * slopes[0]).sum() - (moves[0] * slopes[1]).sum()) > 1e-3


# --- in scenes ------------------------------------------------------------------------------------------------------

FINGER = """\
cqrun: 1
world: {size: [0.12, 0.1], dx: 0.005, gravity: [0, -9.81], frame: reference}
bodies:
  finger:
    shape:
      difference:
        - box: {corner: [0.02, 0.03], size: [0.08, 0.04]}
        - box: {corner: [0.035, 0.045], size: [0.05, 0.015]}
    particles_per_cell: 4
    material: {density: 1000, elastic: {neo_hookean: {youngs_modulus: 1.0e5, poissons_ratio: 0.3}}}
boundaries: {clamp: {sticky: {region: {box: {corner: [0, 0], size: [0.03, 0.1]}}}}}
actuators: {air: {chamber: {body: finger, pressure: 4000}}}
activation: {signals: {air: [0.3, 1]}, interpolate: linear}
measure:
  volume: {chamber_volume: {chamber: air}}
  pressure: {chamber_pressure: {chamber: air}}
  work: {work: {actuator: air}}
objective:
  tip: {reach: {body: finger, position: [0.1, 0.05]}}
  big: {measured: {quantity: volume, target: 0.0009, weight: 1.0e4}}
time: {duration: 0.03, control_step: 0.01}
unknowns:
  bodies.finger.material.elastic.neo_hookean.youngs_modulus: {bounds: [5.0e4, 5.0e5], scale: log}
  actuators.air.chamber.pressure: {bounds: [1.0e3, 1.0e4]}
  activation.signals.air.0: {bounds: [0, 1]}
"""


def finger(folder, supply: str = "pressure"):
    """Write the scene with a chamber of this supply; return its path."""
    amount = {"pressure": "pressure: 4000", "gas": "gas: 6000", "liquid": "liquid: 0.2, bulk_modulus: 1.0e5"}[supply]
    text = FINGER.replace("pressure: 4000}", amount + "}")
    bounds = {"pressure": "[1.0e3, 1.0e4]", "gas": "[1.0e3, 1.0e4]", "liquid": "[0.05, 0.5]"}[supply]
    text = text.replace("air.chamber.pressure: {bounds: [1.0e3, 1.0e4]}", f"air.chamber.{supply}: {{bounds: {bounds}}}")
    (folder / "finger.yaml").write_text(text)
    return folder / "finger.yaml"


LEARNT = [
    "activation=null", "controller={open_loop: {initial: 0.6}}",
    "objective.pressed={measured: {quantity: pressure, target: 3000, weight: 1.0e-7}}",
    "objective.worked={measured: {quantity: work, target: 0.1, weight: 0.1}}",
    "unknowns.activation.signals.air.0=null",
]  # fmt: skip
"""A controller in place of a signal, and terms that only a controller can have."""


@needs_jit
@SUPPLY
@pytest.mark.parametrize("given", [[], ["start=equilibrium"], LEARNT], ids=["moves", "from rest", "learns"])
def test_the_gradient_of_a_motion(supply, given, tmp_path):
    """By the modulus, the supply and the activations, through positions, volume, pressure and work."""
    run, agrees = run_gradcheck(finger(tmp_path, supply), given, tmp_path / "out", threads=1)
    assert agrees
    rows = json.loads((run / "gradcheck.json").read_text())["rows"]
    assert len(rows) >= 4
    assert max(row["error"] for row in rows) < 1e-7


def measured(run):
    """Return volume, pressure and work of a run, each (T+1,)."""
    found = read_trajectory(run / "trajectory.h5").measured
    return [found.quantities[name].values[:, 0] for name in ("volume", "pressure", "work")]


@needs_jit
@pytest.mark.parametrize("start", ["rest_shape", "equilibrium"])
def test_the_gradient_with_a_pressure_on_a_patch(start, tmp_path):
    """An open patch on the upper side: at equilibrium the tangent is not symmetric."""
    top = "{box: {corner: [0.06, 0.065], size: [0.04, 0.01]}}"
    given = [
        f"start={start}", f"actuators={{push: {{surface_pressure: {{body: finger, region: {top}, pressure: 800}}}}}}",
        "activation.signals={push: [0.8, 1]}", "measure=null", "objective.big=null",
        "unknowns.actuators.air.chamber.pressure=null", "unknowns.activation.signals.air.0=null",
        "unknowns.actuators.push.surface_pressure.pressure={bounds: [100, 2000]}",
    ]  # fmt: skip
    run, agrees = run_gradcheck(finger(tmp_path), given, tmp_path / "out", threads=1)
    assert agrees
    rows = json.loads((run / "gradcheck.json").read_text())["rows"]
    assert len(rows) == 3
    assert max(row["error"] for row in rows) < 1e-7


@needs_jit
def test_what_is_measured(tmp_path):
    """The work of a given pressure is p dV summed over control steps."""
    run = run_simulate(finger(tmp_path), ["activation.signals.air=[1]"], tmp_path / "out", threads=1)
    volume, pressure, work = measured(run)
    assert volume[0] == pytest.approx(0.05 * 0.015, rel=1e-7)  # the skin is found to 5e-8
    assert pressure == pytest.approx(4000)
    assert volume[-1] > 1.05 * volume[0]
    assert work[-1] == pytest.approx(4000 * (volume[-1] - volume[0]), rel=1e-9)


@needs_jit
def test_threads_change_no_bit(tmp_path):
    runs = [run_simulate(finger(tmp_path, "gas"), [], tmp_path / f"{n}", threads=n) for n in (1, 2)]
    for one, two in zip(*(measured(run) for run in runs), strict=True):
        assert np.array_equal(one, two)


def test_a_region_names_cavities(tmp_path):
    hollow = "regions={hole: {box: {corner: [0.035, 0.045], size: [0.05, 0.015]}}}"
    model = build(load_scene(finger(tmp_path), [hollow, "actuators.air.chamber.region=hole"])).model
    whole = build(load_scene(finger(tmp_path))).model
    assert np.array_equal(model.actuators[0].constants, whole.actuators[0].constants)


BAD = {
    "open": (
        ["bodies.finger.shape.difference.shapes.1.box.size=[0.1, 0.015]"],
        "has no closed cavity: make one with `difference`, or a mesh with an inner shell",
    ),
    "elsewhere": (["actuators.air.chamber.at=[0.05, 0.035]"], r"\(0.05, 0.035\) lies in no cavity of 'finger'"),
    "the same twice": (
        ["actuators.air.chamber.each={a: [0.04, 0.05], b: [0.08, 0.05]}", "activation=null", "unknowns=null"],
        "'a' and 'b' are in one cavity",
    ),
    "a patch of nothing": (
        [
            "actuators={p: {surface_pressure: {body: finger, pressure: 1, "
            "region: {box: {corner: [0.05, 0.034], size: [0.01, 0.006]}}}}}",
            "activation=null",
            "unknowns=null",
        ],
        "no part of the surface of 'finger' lies in the region",
    ),
    "two supplies": (["actuators.air.chamber.gas=100"], "needs exactly one of `pressure`, `gas` and `liquid`"),
    "no supply": (["actuators.air.chamber.pressure=null"], "has none"),
    "at and each": (
        ["actuators.air.chamber.each={a: [0.04, 0.05]}", "actuators.air.chamber.at=[0.04, 0.05]"],
        "`at` and `each` say which cavities are meant",
    ),
    "a region without": (
        ["actuators.air.chamber.region={box: {corner: [0.02, 0.03], size: [0.01, 0.01]}}"],
        "no cavity of 'finger' lies in the region",
    ),
    "three numbers": (["actuators.air.chamber.at=[0.04, 0.05, 0]"], "must have 2 entries"),
    "the other frame": (["world.frame=updated"], "acts in the reference frame alone"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_refused(name, tmp_path):
    overrides, message = BAD[name]
    with pytest.raises(SceneError, match=message):
        build(load_scene(finger(tmp_path), [*overrides, "measure=null", "objective=null"]))
