"""Images: pixels that form a body, groups named by colour, and images without a body."""

from __future__ import annotations

import re
import struct
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as Pillow
from pydantic import ValidationError

from cqrun.build.particles import Particles, sample
from cqrun.errors import SceneError, UsageError
from cqrun.geometry.difference import Difference
from cqrun.geometry.image import Image
from cqrun.geometry.intersection import Intersection
from cqrun.geometry.random import Random
from cqrun.geometry.transformed import Transformed
from cqrun.geometry.union import Union
from cqrun.scene.load import load_scene

WHITE, RED, BLUE, PINK = (255, 255, 255), (220, 20, 20), (0, 0, 255), (255, 210, 210)


def save(path: Path, pixels: Any) -> str:
    """Save pixels (rows from the top, columns, 3 or 4) as PNG."""
    Pillow.fromarray(np.array(pixels, np.uint8)).save(path)
    return str(path)


@pytest.fixture
def flag(tmp_path: Path) -> str:
    """Return an image of 4 x 6 pixels: red above blue, white around, and a pink pixel that belongs to neither."""
    pixels = np.full((4, 6, 3), WHITE)
    pixels[1, 1:4], pixels[2, 1:4], pixels[1, 4] = RED, BLUE, PINK
    return save(tmp_path / "flag.png", pixels)


def image(file: str, **fields: Any) -> Image:
    size = {} if "width" in fields or "height" in fields else {"height": 0.4}
    return Image.model_validate({"file": file, **size, **fields})


def middles(body: Image, columns: Any, rows_from_below: Any) -> np.ndarray:
    """Return the middles of pixels 0.1 m wide at the corner (1, 2)."""
    return np.stack([1.05 + 0.1 * np.asarray(columns), 2.05 + 0.1 * np.asarray(rows_from_below)], axis=-1)


def test_opaque_pixels_that_are_not_white_are_the_body(flag: str) -> None:
    body = image(flag, corner=[1.0, 2.0])
    assert body.examine() == []
    lower, upper = body.bounds()
    assert lower == pytest.approx([1.1, 2.1])
    assert upper == pytest.approx([1.5, 2.3])
    assert body.volume() == pytest.approx(7 * 0.01)
    x = middles(body, [0, 1, 3, 4, 4, 5, -1, 9], [2, 2, 1, 2, 1, 2, 1, 1])
    assert body.inside(x).tolist() == [False, True, True, True, False, False, False, False]


def test_width_and_height_give_the_same_pixels(flag: str, rng: np.random.Generator) -> None:
    x = rng.uniform(-0.1, 0.7, (500, 2))
    by_width, by_height = image(flag, width=0.6), image(flag, height=0.4)
    assert by_height.bounds()[1] == pytest.approx([0.5, 0.3])
    assert (by_width.inside(x) == by_height.inside(x)).all()


def test_colours_pick_the_nearest_within_the_tolerance(flag: str) -> None:
    body = image(flag, corner=[1.0, 2.0], colours={"top": "#ff0000", "low": "#0000FF"}, tolerance=40)
    x = middles(body, [1, 1, 4, 0], [2, 1, 2, 0])
    assert body.colour_names == ("top", "low")
    assert body.coloured(x, "top").tolist() == [True, False, False, False]
    assert body.coloured(x, "low").tolist() == [False, True, False, False]
    assert body.coloured(x, "#ffd2d2").tolist() == [False, False, True, False]
    with pytest.raises(
        UsageError, match=r"'white' is not a colour of .*: its named colours are top, low; or give #rrggbb"
    ):
        body.coloured(x, "white")
    # colours that are near to each other share no pixel
    reds = image(flag, corner=[1.0, 2.0], colours={"a": "#dc1414", "b": "#e61e1e"}, tolerance=40)
    assert not (reds.coloured(x, "a") & reds.coloured(x, "b")).any()


def test_transparent_pixels_are_not_part_of_the_body(tmp_path: Path) -> None:
    pixels = np.zeros((2, 2, 4))
    pixels[0] = [*WHITE, 255]
    pixels[1] = [*RED, 100]
    body = image(save(tmp_path / "clear.png", pixels), height=2.0)
    assert body.inside(np.array([[0.5, 1.5], [0.5, 0.5]])).tolist() == [True, False]
    cut = image(save(tmp_path / "clear.png", pixels[::-1]), height=2.0, background="#ffffff")
    with pytest.raises(UsageError, match="none of its 2 x 2 pixels is part of a body: all are transparent or the"):
        cut.examine()


def test_background_of_another_colour(flag: str) -> None:
    body = image(flag, corner=[1.0, 2.0], background="#0000ff")
    assert body.inside(middles(body, [0, 1, 1], [0, 1, 2])).tolist() == [True, False, True]


def test_combined_shapes_keep_the_colours_of_their_image(flag: str) -> None:
    data = {"image": {"file": flag, "height": 0.4, "colours": {"top": "#dc1414"}}}
    hole = {"ball": {"center": [0, 0], "radius": 0.01}}
    turned = Transformed.model_validate(
        {"shape": {"union": [{"difference": [data, hole]}, hole]}, "offset": [1.0, 2.0], "angle": 90}
    )
    assert turned.colour_names == ("top",)
    x = turned.to_world(np.array([[0.15, 0.25], [0.15, 0.15]]))
    assert turned.coloured(x, "top").tolist() == [True, False]
    assert Difference.model_validate({"shapes": [hole, data]}).colour_names == ()
    both = Union.model_validate({"shapes": [data], "scale": 2.0})
    assert both.coloured(np.array([[0.3, 0.5]]), "top").tolist() == [True]


def test_image_can_be_filled_with_particles(flag: str) -> None:
    points, volume = Random(count=500).sample(image(flag), None)
    assert image(flag).inside(points).all()
    assert volume.sum() == pytest.approx(0.07)


def test_changed_file_is_read_again(flag: str) -> None:
    assert image(flag).volume() == pytest.approx(0.07)
    pixels = np.full((4, 6, 3), WHITE)
    pixels[0, :2], pixels[1, 1] = RED, BLUE
    save(Path(flag), pixels)
    assert image(flag).volume() == pytest.approx(0.03)


@pytest.mark.parametrize(
    ("pixels", "words"),
    [
        (np.full((3, 5, 3), WHITE), "all of its 5 x 3 pixels have the colour #ffffff"),
        (np.full((3, 5, 3), RED), "all of its 5 x 3 pixels have the colour #dc1414"),
        (np.zeros((3, 5, 4)), "all of its 5 x 3 pixels are transparent"),
    ],
)
def test_image_of_one_colour_is_an_error(pixels: np.ndarray, words: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=f"plain.png: an image of one colour, nothing can be cut out: {words}"):
        image(save(tmp_path / "plain.png", pixels)).examine()


def test_error_for_a_missing_colour_lists_the_most_common_ones(flag: str) -> None:
    words = "no pixel has the colour 'leg' (#00ff00); the most common are #0000ff (42.9%), #dc1414 (42.9%), #ffd2d2"
    with pytest.raises(UsageError, match=re.escape(words)):
        image(flag, colours={"leg": "#00ff00", "low": "#0000ff"}).examine()


def test_files_without_a_readable_image_are_errors(tmp_path: Path, flag: str) -> None:
    with pytest.raises(UsageError, match=r"none.png: cannot be read \(No such file or directory\)"):
        image(str(tmp_path / "none.png")).examine()
    (tmp_path / "text.png").write_text("no picture")
    with pytest.raises(UsageError, match=r"text\.png: is not a PNG; only PNG is read, whatever a file is called"):
        image(str(tmp_path / "text.png")).examine()
    big = save(tmp_path / "big.png", np.random.default_rng(0).integers(0, 255, (60, 60, 3)))
    cut = tmp_path / "cut.png"
    cut.write_bytes(Path(big).read_bytes()[:4000])
    with pytest.raises(UsageError, match=r"cut\.png: cannot be read as PNG: .*; save it again"):
        image(str(cut)).examine()


def test_image_that_is_too_large_is_an_error(flag: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cqrun.geometry.image.MAX_PIXELS", 20)
    Path(flag).touch()
    with pytest.raises(UsageError, match="6 x 4 pixels; at most 20 are read"):
        image(flag).examine()
    monkeypatch.setattr("PIL.Image.MAX_IMAGE_PIXELS", 10)  # the reader refuses twice as many in its own words
    with pytest.raises(UsageError, match=r"\.png: has far too many pixels; at most 20 are read"):
        image(flag).examine()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"height": 1.0, "width": 1.0}, "exactly one of height, width; has height and width"),
        ({"width": None}, "exactly one of height, width; has none"),
        ({"colours": {"leg": "red"}}, "a colour is #rrggbb"),
        ({"colours": {"left leg": "#ff0000"}}, "a name has letters, digits and _"),
        ({"background": "#fff"}, "a colour is #rrggbb"),
        ({"file": ""}, "at least 1 char"),
    ],
)
def test_invalid_fields_are_errors(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError) as info:
        image(fields.pop("file", "a.png"), **fields)
    assert message in str(info.value)


def test_image_needs_a_2d_world() -> None:
    assert "an image needs a 2D world" in image("a.png").dim_problems(3)[0][1]
    assert image("a.png", corner=[0.0, 0.0]).dim_problems(2) == []


def test_16_bit_grey_is_scaled(tmp_path: Path) -> None:
    grey = np.full((2, 3), 65535, np.uint16)
    grey[:, 0], grey[:, 1] = 0x4040, 0x8080
    Pillow.fromarray(grey).save(tmp_path / "grey.png")
    body = image(str(tmp_path / "grey.png"), height=0.2, colours={"dark": "#404040", "pale": "#808080"})
    assert body.examine() == []
    x = np.array([[0.05, 0.05], [0.15, 0.05], [0.25, 0.05]])
    np.testing.assert_array_equal(body.coloured(x, "dark"), [True, False, False])
    np.testing.assert_array_equal(body.coloured(x, "pale"), [False, True, False])


def png(path: Path, samples: np.ndarray, depth: int, clear: tuple[int, ...]) -> str:
    """Save samples (rows, columns) of grey or (rows, columns, 3) as PNG with `depth` bits and a transparent colour."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    rows = samples.reshape(len(samples), -1)
    bits = (rows[..., None] >> np.arange(depth)[::-1] & 1).reshape(len(rows), -1).astype(np.uint8)
    lines = b"".join(b"\0" + np.packbits(line).tobytes() for line in bits)
    head = struct.pack(">IIBBBBB", samples.shape[1], len(samples), depth, 0 if samples.ndim == 2 else 2, 0, 0, 0)
    transparent = b"".join(struct.pack(">H", sample) for sample in clear)
    parts = [(b"IHDR", head), (b"tRNS", transparent), (b"IDAT", zlib.compress(lines)), (b"IEND", b"")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts))
    return str(path)


@pytest.mark.parametrize(
    ("depth", "clear", "body"),
    [
        *((depth, (clear,), (body,)) for depth in (1, 2, 4, 8, 16) for clear, body in ((0, 1), (1, 0))),
        *((depth, (1,), (2**depth - 1,)) for depth in (2, 4, 8, 16)),  # the body is white
        (16, (0x1234,), (0x1235,)),
        *((depth, (2**depth - 1, 0, 7), (0, 0, 0)) for depth in (8, 16)),
        *((depth, (0, 0, 0), (2**depth - 1,) * 3) for depth in (8, 16)),
    ],
)
def test_transparent_colour_is_found_in_samples_of_any_size(
    depth: int, clear: tuple[int, ...], body: tuple[int, ...], tmp_path: Path
) -> None:
    samples = np.tile(np.array(clear), (4, 6, 1))
    samples[1:3, 2:5] = body
    file = png(tmp_path / "clear.png", samples[..., 0] if len(clear) == 1 else samples, depth, clear)
    assert image(file, height=4.0).volume() == pytest.approx(6.0)


@pytest.mark.parametrize("kind", ["JPEG", "WEBP", "GIF", "EPS", "TIFF"])
def test_only_png_is_opened_whatever_a_file_is_called(kind: str, tmp_path: Path) -> None:
    Pillow.new("RGB", (4, 4), (255, 0, 0)).save(tmp_path / "picture.png", format=kind)
    with pytest.raises(UsageError, match=r"picture\.png: is not a PNG; only PNG is read"):
        image(str(tmp_path / "picture.png")).examine()


def test_image_too_large_for_the_memory_is_refused_before_it_is_read(
    flag: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    Path(flag).touch()
    monkeypatch.setattr("cqrun.geometry.image._PIXEL_MEMORY", 2**60)
    monkeypatch.setattr(Pillow.Image, "convert", lambda *_: pytest.fail("it was read"))
    with pytest.raises(UsageError, match=r"flag\.png: reading it needs about .* are free: save it with fewer pixels"):
        image(flag).examine()


def test_memory_does_not_grow_with_the_number_of_colours(tmp_path: Path) -> None:
    side = 300
    colours = {f"c{k}": f"#{k:02x}0000" for k in range(50)}
    pixels = np.zeros((side, side, 3))
    pixels[..., 0] = np.arange(side * side).reshape(side, side) % 50
    body = image(save(tmp_path / "many.png", pixels), colours=colours, background="#00ff00", tolerance=0)
    body.volume()  # the file is read
    tracemalloc.start()
    assert body.examine() == []
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 30 * side * side


def test_missing_or_duplicate_colours_are_errors(flag: str) -> None:
    with pytest.raises(
        UsageError, match=r"'rod' is not a colour of .*: its named colours are red \(did you mean 'red'\?\)"
    ):
        image(flag, colours={"red": "#dc1414"}).coloured(np.zeros((1, 2)), "rod")
    with pytest.raises(UsageError, match=r"no pixel of .* has the colour #00ff00; the most common are #0000ff"):
        image(flag).coloured(np.zeros((1, 2)), "#00ff00")
    with pytest.raises(UsageError, match="b: its colour has another name too"):
        image(flag, colours={"a": "#dc1414", "b": "#dc1414"}).examine()


@pytest.fixture
def leaf(tmp_path: Path) -> str:
    """Return an image of 1 x 2 pixels, green beside blue."""
    return save(tmp_path / "leaf.png", [[(0, 160, 0), BLUE]])


@pytest.mark.parametrize("kind", [Union, Intersection])
def test_each_image_gives_its_own_colours(kind: Any, flag: str, leaf: str) -> None:
    first = {"image": {"file": flag, "height": 0.4, "colours": {"top": "#dc1414"}}}
    second = {"image": {"file": leaf, "height": 0.1, "corner": [0.1, 0.2], "colours": {"green": "#00a000"}}}
    both = kind.model_validate({"shapes": [first, second, {"box": {"corner": [0, 0], "size": [1, 1]}}]})
    assert both.colour_names == ("top", "green")
    x = np.array([[0.15, 0.25], [0.25, 0.25], [0.35, 0.25], [0.15, 0.15]])
    assert both.coloured(x, "top").tolist() == [True, True, True, False]
    assert both.coloured(x, "green").tolist() == [True, False, False, False]
    assert both.coloured(x, "#00a000").tolist() == [True, False, False, False]
    assert both.coloured(x, "#0000ff").tolist() == [False, True, False, True]
    with pytest.raises(UsageError, match=r"no pixel of .*flag\.png has the colour #123456"):
        both.coloured(x, "#123456")
    with pytest.raises(UsageError, match=r"'rod' is not a colour of .*flag\.png: its named colours are top"):
        both.coloured(x, "rod")


MATERIAL = {"density": 1.0, "elastic": {"neo_hookean": {"youngs_modulus": 1.0, "poissons_ratio": 0.3}}}


def sampled(body: dict[str, Any]) -> Particles:
    body = {"spacing": 0.02, "material": MATERIAL, **body}
    time = {"duration": 0.1, "control_step": 0.1}
    return sample(
        load_scene(
            {"cqrun": 1, "world": {"size": [1, 1], "dx": 0.05, "frame": "updated"}, "bodies": {"a": body}, "time": time}
        )
    )


def test_parts_may_be_images_with_different_colours(flag: str, leaf: str) -> None:
    first = {"image": {"file": flag, "height": 0.4, "colours": {"top": "#dc1414"}}}
    second = {"image": {"file": leaf, "height": 0.1, "corner": [0.6, 0.6], "colours": {"green": "#00a000"}}}
    blue = {"blue": {"colour": "#0000ff"}}
    groups = sampled({"parts": {"first": first, "second": second}, "groups": blue}).groups("a")
    assert {name: len(members) for name, members in groups.items() if name not in ("first", "second")} == {
        "top": 75, "green": 25, "blue": 100
    }  # fmt: skip


def test_error_names_the_colour_that_is_cut_away(flag: str) -> None:
    whole = {"image": {"file": flag, "height": 0.4, "colours": {"top": "#dc1414", "low": "#0000ff"}}}
    with pytest.raises(SceneError, match=r"bodies.a.shape: the colour 'top' holds no particle"):
        sampled({"shape": {"intersection": [whole, {"box": {"corner": [0, 0], "size": [1, 0.2]}}]}})
