"""Cells and particles across the thinnest part of a body: of shapes, parts, images and meshes."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from cqrun.build.model import build
from cqrun.build.raster import thinnest
from cqrun.build.thickness import thinnest_parts
from cqrun.scene.load import load_scene

MATERIAL = {"density": 1000, "elastic": {"fixed_corotated": {"youngs_modulus": 1e4, "poissons_ratio": 0.3}}}


def box(corner, size):
    return {"box": {"corner": corner, "size": size}}


def part_of(base=None, dx=0.02, size=(1, 1), **body):
    """Return the thinnest part of a body with 4 particles per cell in 2D, and 8 in 3D."""
    scene = {
        "cqrun": 1,
        "world": {"size": list(size), "dx": dx},
        "bodies": {"a": {"particles_per_cell": 2 ** len(size), "material": MATERIAL, **body}},
        "time": {"duration": 0.1, "control_step": 0.1},
    }
    (part,) = thinnest_parts(build(load_scene(scene, base=base))).values()
    return part


@pytest.mark.parametrize("place", [None, {"angle": 30, "offset": [0.4, 0.2]}, {"scale": 0.5, "offset": [0.3, 0.3]}])
@pytest.mark.parametrize("height", [0.06, 0.05, 0.1])
def test_a_bar(height, place):
    part = part_of(shape=box([0.1, 0.1], [0.4, height]), place=place)
    scale = (place or {}).get("scale", 1.0)
    assert part.thickness == pytest.approx(scale * height)
    assert part.cells == pytest.approx(scale * height / 0.02)
    assert part.particles == pytest.approx(2 * scale * height / 0.02)


def test_a_plate_and_a_bar_in_3d():
    plate = part_of(dx=0.05, size=(1, 1, 1), shape=box([0.2, 0.2, 0.2], [0.5, 0.15, 0.5]))
    assert (plate.cells, plate.particles) == (pytest.approx(3), pytest.approx(6))
    assert part_of(dx=0.05, size=(1, 1, 1), shape=box([0.2, 0.2, 0.2], [0.5, 0.25, 0.15])).cells == pytest.approx(3)


def test_legs_and_hinges_are_thinner_than_the_body():
    legs = {f"leg{k}": box([0.3 + 0.2 * k, 0.2], [0.06, 0.3]) for k in range(2)}
    assert part_of(shape=None, parts={"trunk": box([0.3, 0.5], [0.26, 0.2])} | legs).cells == pytest.approx(3)
    blocks = {"left": box([0.1, 0.4], [0.3, 0.3]), "right": box([0.48, 0.4], [0.3, 0.3])}
    hinge = {"hinge": box([0.4, 0.53], [0.08, 0.08])}  # less than a tenth of the body
    assert part_of(shape=None, parts=blocks | hinge).cells == pytest.approx(4)
    assert part_of(shape=None, parts=blocks | {"joined": box([0.4, 0.4], [0.08, 0.3])}).cells == pytest.approx(15)


def test_a_ball_is_as_thick_as_its_diameter():
    assert part_of(shape={"ball": {"center": [0.5, 0.5], "radius": 0.15}}).thickness == pytest.approx(0.3, rel=0.05)
    ball = part_of(dx=0.05, size=(1, 1, 1), shape={"ball": {"center": [0.5, 0.5, 0.5], "radius": 0.2}})
    assert ball.thickness == pytest.approx(0.4, rel=0.1)


def test_an_image(tmp_path):
    pixels = np.zeros((40, 80, 4), np.uint8)
    pixels[12:28, 8:72] = 255  # 16 of 80 pixels high
    pixels[12:28, 8:72, :3] = 60
    Image.fromarray(pixels).save(tmp_path / "bar.png")
    part = part_of(base=tmp_path, shape={"image": {"file": "bar.png", "width": 0.8, "corner": [0.1, 0.3]}})
    assert part.thickness == pytest.approx(0.16, abs=0.01)


def test_a_mesh(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box(extents=[0.6, 0.15, 0.3]).export(tmp_path / "plate.stl")
    part = part_of(base=tmp_path, dx=0.05, size=(1, 1, 1), shape={"mesh": {"file": "plate.stl"}},
                   place={"offset": [0.5, 0.5, 0.5]})  # fmt: skip
    assert part.cells == pytest.approx(3, abs=0.26)


@pytest.mark.parametrize("layers", range(1, 9))
def test_even_and_odd_numbers_of_layers(layers):
    """Twice the distance to the outside alone is one too many for an odd number."""
    assert thinnest(np.ones((layers, 40), bool)) == layers
    assert thinnest(np.ones((40, layers, 20), bool)) == layers
