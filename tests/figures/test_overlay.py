"""Simulations and equilibria in one picture: a panel for each number, a line for each run."""

from __future__ import annotations

import pytest
from tiny_beam import BEAM, NU, E

from cqrun.errors import UsageError
from cqrun.figures.draw import draw_several
from cqrun.figures.overlay import STYLES, _style, draw_overlay
from cqrun.figures.run_data import read_run
from cqrun.figures.style import COLOURS, styled
from cqrun.jobs.rest import REST
from cqrun.jobs.simulate import run_simulate

MEASURED = BEAM + "measure: {tip: {displacement: {point: [0.215, 0.22]}}}\n"
AT_REST = MEASURED + "path: {world.gravity.1: [-2, -4]}\n"


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("overlay")
    (folder / "beam.yaml").write_text(MEASURED)
    (folder / "hanging.yaml").write_text(AT_REST)
    return folder


@pytest.fixture(scope="module")
def moving(out):
    """Return three simulations: the second has other steps, the third measures more."""
    speed = "measure.fast={velocity: {body: beam}}"
    each = [[], [f"{E}=1e5", "time.control_step=0.005"], [f"{E}=2e5", f"{NU}=0.2", speed]]
    return [run_simulate(out / "beam.yaml", overrides, out / "out", threads=1) for overrides in each]


@pytest.fixture(scope="module")
def resting(out):
    return [REST.run(out / "hanging.yaml", overrides, out / "out", threads=1) for overrides in ([], [f"{E}=1e5"])]


def panels(runs, name=None):
    """Return the panels of the picture by their labels, and the texts of its legend."""
    with styled():
        figure = draw_overlay([read_run(run) for run in runs], name)
    return {axes.get_ylabel(): axes for axes in figure.axes}, [text.get_text() for text in figure.legends[0].texts]


def test_each_run_has_a_line_with_its_own_times(moving):
    shown, _ = panels(moving)
    assert list(shown)[:4] == ["tip.x [mm]", "tip.y [mm]", "fast.x [m/s]", "fast.y [m/s]"]
    tip = shown["tip.y [mm]"]
    assert [len(line.get_xdata()) for line in tip.lines] == [11, 21, 11]
    assert [line.get_color() for line in tip.lines] == list(COLOURS[:3])
    assert tip.get_xlabel() == "time [s]"
    assert {"clamp.force_y [N/m]", "beam.y [mm]"} <= set(shown)


def test_what_only_one_run_has_is_one_line_in_its_colour(moving):
    shown, _ = panels(moving)
    (line,) = shown["fast.x [m/s]"].lines
    assert line.get_color() == COLOURS[2]


def test_the_legend_names_what_differs(moving):
    _, labels = panels(moving[:2])
    assert labels == [
        "beam, neo_hookean.youngs_modulus 50000, time.control_step 0.01",
        "beam, neo_hookean.youngs_modulus 100000, time.control_step 0.005",
    ]
    assert panels([moving[0], moving[0]])[1] == [f"beam {moving[0].name}"] * 2


def test_equilibria_are_drawn_along_their_path(resting):
    shown, labels = panels(resting)
    tip = shown["tip.y [mm]"]
    assert tip.get_xlabel() == "world.gravity.1 [m/s^2]"
    assert [line.get_xdata().tolist() for line in tip.lines] == [[-2.0, -4.0]] * 2
    softer, stiffer = (line.get_ydata() for line in tip.lines)
    assert (softer < stiffer).all()
    assert labels == ["hanging, neo_hookean.youngs_modulus 50000", "hanging, neo_hookean.youngs_modulus 100000"]


def test_a_force_that_is_zero_but_for_rounding_looks_like_zero(resting):
    shown, _ = panels(resting)
    low, high = shown["clamp.force_x [N/m]"].get_ylim()
    assert low < -30.0
    assert high > 30.0


def test_one_quantity_can_be_shown_alone(moving):
    assert list(panels(moving, "tip")[0]) == ["tip.x [mm]", "tip.y [mm]"]
    assert list(panels(moving, "tip.y")[0]) == ["tip.y [mm]"]
    with pytest.raises(UsageError, match=r"--show tip.z: no run has it \(did you mean 'tip.[xy]'"):
        panels(moving, "tip.z")


def test_a_motion_and_an_equilibrium_have_no_common_axis(moving, resting):
    with pytest.raises(UsageError, match="along different things, which one axis cannot compare"):
        panels([moving[0], resting[0]])


def test_the_picture_has_the_names_of_the_scenes(moving, tmp_path):
    (picture,) = draw_several(moving, tmp_path)
    assert picture == tmp_path / "compare_beam.png"
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_more_runs_than_colours_have_other_lines():
    every = [tuple(_style(place).values()) for place in range(len(COLOURS) * len(STYLES))]
    assert len(set(every)) == len(every)
