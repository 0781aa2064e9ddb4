"""Make pictures small enough for a page of limited size, and write them into it as data URIs."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cqrun.disk import open_file
from cqrun.errors import UsageError
from cqrun.report.blocks import Picture
from cqrun.store.atomic import disk_errors

STEPS = ((None, None), (1600, 256), (1280, 192), (1000, 128), (760, 64), (520, 32), (360, 16))
"""Largest width [pixels] and number of colours of a picture, tried in this order until it is small enough."""

LARGEST = 30_000_000
"""Pixels of the largest picture that is read."""


@dataclass(frozen=True)
class Image:
    """A picture as the page has it: its data URI and size [pixels]; `still` is a film's last picture."""

    uri: str
    width: int
    height: int
    still: str = ""


def images(pictures: Sequence[Picture], room: int) -> dict[Picture, Image]:
    """Return the pictures that fit into `room` bytes together, the small ones as they are and the others reduced.

    Raises:
        UsageError: a picture cannot be read.
    """
    contents = {picture: _read(picture.path) for picture in dict.fromkeys(pictures)}
    left, found = float(room), {}
    waiting = sorted(contents, key=lambda picture: (picture.path.suffix != ".gif", len(contents[picture])))
    for k, picture in enumerate(waiting):
        share = left if picture.path.suffix == ".gif" else left / (len(waiting) - k)
        image = _image(picture.path, contents[picture], int(0.74 * share))
        if image is not None:
            found[picture] = image
            left -= len(image.uri) + len(image.still)
    return found


def _read(path: Path) -> bytes:
    with disk_errors(path), open_file(path) as file:
        return bytes(file.read())


def _image(path: Path, content: bytes, most: int) -> Image | None:
    """Return a picture in at most `most` bytes; None if it cannot be that small."""
    from PIL import Image as Pillow

    try:
        with Pillow.open(io.BytesIO(content), formats=("PNG", "GIF")) as image:
            if image.width * image.height > LARGEST:
                raise ValueError(f"{image.width} x {image.height} pixels")
            if image.format == "GIF":
                still = _last(image) if getattr(image, "n_frames", 1) > 1 else b""
                fits = len(content) + len(still) <= most
                uris = _uri("gif", content), _uri("png", still) if still else ""
                return Image(uris[0], image.width, image.height, uris[1]) if fits else None
            for width, colours in STEPS:
                small, size = (content, image.size) if width is None else _reduced(image, width, colours or 2)
                if len(small) <= most:
                    return Image(_uri("png", small), *size)
            return None
    except (OSError, ValueError, SyntaxError, EOFError, Pillow.DecompressionBombError) as error:
        raise UsageError(f"{path}: is not a picture that can be read ({error}); delete it, or draw it again") from error


def _reduced(image: object, width: int, colours: int) -> tuple[bytes, tuple[int, int]]:
    """Return a picture as PNG with at most this width and number of colours, and its size."""
    from PIL import Image as Pillow

    assert isinstance(image, Pillow.Image)
    plain = image.convert("RGB")
    if plain.width > width:
        plain = plain.resize((width, max(1, round(plain.height * width / plain.width))), Pillow.Resampling.LANCZOS)
    few = plain.quantize(colours, method=Pillow.Quantize.MEDIANCUT, dither=Pillow.Dither.NONE)
    return _png(few), plain.size


def _last(film: object) -> bytes:
    """Return the last picture of a film, for readers who want nothing to move."""
    from PIL import Image as Pillow

    assert isinstance(film, Pillow.Image)
    film.seek(getattr(film, "n_frames", 1) - 1)
    return _png(film.convert("RGB").quantize(64, method=Pillow.Quantize.MEDIANCUT, dither=Pillow.Dither.NONE))


def _png(image: object) -> bytes:
    from PIL import Image as Pillow

    assert isinstance(image, Pillow.Image)
    content = io.BytesIO()
    image.save(content, "PNG", optimize=True)
    return content.getvalue()


def _uri(kind: str, content: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
