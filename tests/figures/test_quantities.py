"""Key paths, units and numbers in pictures."""

from __future__ import annotations

import pytest

from cqrun.figures.quantities import error, estimate, labels, length_unit, number, shown_unit

E = "material.elastic.fixed_corotated.youngs_modulus"


@pytest.mark.parametrize(
    ("path", "label"),
    [
        (f"bodies.beam.{E}", "Young's modulus"),
        ("bodies.beam.material.elastic.neo_hookean.poissons_ratio", "Poisson's ratio"),
        ("bodies.beam.material.density", "Density"),
        ("bodies.beam.material.viscosity.shear", "Shear viscosity"),
        ("loads.air.damping.rate", "Damping rate"),
        ("data.recordings.bare.start", "Bare start"),
        ("world.gravity.2", "Gravity z"),
    ],
)
def test_a_path_has_a_short_name(path, label):
    assert labels([path], 3) == [label]


def test_equal_names_get_their_differences_as_a_prefix():
    assert labels([f"bodies.beam.{E}", f"bodies.tip.{E}", "bodies.beam.material.density"], 2) == [
        "beam: Young's modulus",
        "tip: Young's modulus",
        "Density",
    ]


def test_a_value_of_one_recording_has_its_name():
    own = [f"data.recordings.{name}.overrides.world.gravity.1" for name in ("bare", "loaded")]
    rates = [f"data.recordings.bare.overrides.loads.{name}.damping.rate" for name in ("air", "oil")]
    assert labels([*own, "world.gravity.1", "data.recordings.bare.offset.2", *rates], 3) == [
        "bare: Gravity y",
        "loaded: Gravity y",
        "Gravity y",
        "bare: Offset z",
        "bare: air: Damping rate",
        "bare: oil: Damping rate",
    ]


@pytest.mark.parametrize(
    ("unit", "largest", "name", "factor"),
    [
        ("Pa", 5e5, "kPa", 1e-3),
        ("Pa", 2e6, "MPa", 1e-6),
        ("Pa", 20.0, "Pa", 1.0),
        ("kg/m^3", 1070.0, "kg/m³", 1.0),
        ("m/s^2", 9.8, "m/s²", 1.0),
        ("1", 0.45, "", 1.0),
        ("m", 0.1, "mm", 1e3),
        ("m", 1.0, "m", 1.0),
    ],
)
def test_units_are_shown_with_a_prefix_that_fits(unit, largest, name, factor):
    assert shown_unit(unit, largest) == (name, factor)


def test_a_label_ends_with_its_unit_if_it_has_one():
    assert length_unit(0.1).label("x") == "x (mm)"
    assert shown_unit("1", 0.3).label("Poisson's ratio") == "Poisson's ratio"


def test_an_estimate_has_as_many_digits_as_are_significant():
    assert estimate(264.159, (263.597, 264.723)) == "264.16 (263.60 to 264.72)"
    assert estimate(49.947, (0.599, 4166.48)) == "50 (1 to 4166)"
    assert estimate(264.159, None) == "264.2"
    assert number(0.25, 0.0) == "0.25"


def test_errors_keep_three_digits():
    assert [error(value) for value in (0.36, 57.0, 123.4)] == ["0.360", "57.0", "123"]
    assert error(float("nan")) == "not seen"


def test_names_of_the_numbers_of_a_shape_and_a_spin():
    paths = ["bodies.arm.shape.polygon.points.2.0", "bodies.arm.shape.polygon.points.3.1"]
    assert labels(paths, 2) == ["Points 2 x", "Points 3 y"]
    assert labels(["bodies.arm.velocity.spin.0"], 2) == ["Spin z"]
    assert labels(["bodies.arm.velocity.spin.0"], 3) == ["Spin x"]


def test_the_placement_of_a_recording_has_its_name():
    paths = ["data.recordings.arm.rotation.0", "data.recordings.arm.offset.0"]
    assert labels(paths, 2) == ["arm: Rotation z", "arm: Offset x"]
    assert labels(paths, 3) == ["arm: Rotation x", "arm: Offset x"]
