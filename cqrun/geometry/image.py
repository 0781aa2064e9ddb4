"""A body that is cut out of an image."""

from __future__ import annotations

import re
import warnings
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from cqrun.errors import UsageError
from cqrun.explain import Loc, complaint, finding, listed, suggest
from cqrun.geometry.file_shape import FileShape, require_memory
from cqrun.plugin.contract import Array, quantity, vector
from cqrun.plugin.registry import plugin

MAX_PIXELS = 40_000_000
"""A larger image is refused: particles are far coarser."""

_PIXEL_MEMORY = 25
"""Memory that a pixel takes while an image is read and its colours are found, as measured [bytes]."""

_OPAQUE = 128
"""Smallest alpha of an opaque pixel, of 255."""


def _is_colour(text: str) -> bool:
    return re.fullmatch(r"#[0-9a-fA-F]{6}", text) is not None


def _colour(text: str) -> str:
    if not _is_colour(text):
        raise ValueError(f"a colour is #rrggbb, two hexadecimal digits each of red, green and blue; is '{text}'")
    return text.lower()


HexColour = Annotated[str, AfterValidator(_colour)]


@plugin("shape", "image")
class Image(FileShape):
    """The pixels of a PNG that are opaque and not background (2D only); `colours` name groups of the body.

    A pixel belongs to the nearest named colour, if that is within `tolerance`. Pixels without a named colour are also
    part of the body.
    """

    height: float | None = quantity("m", "Height of the whole image; or give width", gt=0, geometric=True, default=None)
    width: float | None = quantity("m", "Width of the whole image; or give height", gt=0, geometric=True, default=None)
    corner: list[float] | None = vector(
        "m", "Lower left corner of the image; the origin if absent", geometric=True, default=None
    )
    colours: dict[str, HexColour] = Field(
        description="Name of a group -> colour of its pixels, #rrggbb", default_factory=dict
    )
    background: HexColour | None = Field(
        description="Colour that is not part of the body; white if absent and no pixel is transparent", default=None
    )
    tolerance: int = quantity("1", "Largest difference from a colour in each channel, of 255", ge=0, le=255, default=24)

    @model_validator(mode="after")
    def _one_size(self) -> Self:
        given = [name for name in ("height", "width") if getattr(self, name) is not None]
        if len(given) != 1:
            message = f"must have exactly one of height, width; has {' and '.join(given) or 'none'}"
            raise complaint(self.name, [finding(message, involves=("height", "width"))])
        bad = [name for name in self.colours if not re.fullmatch(r"[A-Za-z_]\w*", name, re.ASCII)]
        if bad:
            message = "a name has letters, digits and _, and does not begin with a digit"
            raise complaint(self.name, [finding(message, ("colours", name)) for name in bad])
        return self

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        if dim != 2:
            return [((), "an image needs a 2D world; in 3D use a mesh")]
        return super().dim_problems(dim)

    @property
    def colour_names(self) -> tuple[str, ...]:
        return tuple(self.colours)

    def inside(self, points: Array) -> Array:
        return self._at(points, self._cut_out())

    def coloured(self, points: Array, colour: str) -> Array:
        if colour in self.colours:
            return self._at(points, self._nearest() == list(self.colours).index(colour))
        if not _is_colour(colour):
            named = f"its named colours are {listed(self.colours)}{suggest(colour, self.colours)}"
            known = named if self.colours else "it has no named colours"
            raise UsageError(f"'{colour}' is not a colour of {self.path}: {known}; or give #rrggbb")
        wanted = self._cut_out() & (self._far_from(colour.lower()) <= self.tolerance)
        if not wanted.any():
            common = ", ".join(_most_common(self._pixels()[self._cut_out()]))
            raise UsageError(f"no pixel of {self.path} has the colour {colour}; the most common are {common}")
        return self._at(points, wanted)

    def bounds(self) -> tuple[Array, Array]:
        body = self._cut_out()
        rows, columns = np.flatnonzero(body.any(axis=1)), np.flatnonzero(body.any(axis=0))
        lower = np.array([columns[0], len(body) - 1 - rows[-1]])
        upper = np.array([columns[-1] + 1, len(body) - rows[0]])
        return self._corner() + self._pixel() * lower, self._corner() + self._pixel() * upper

    def carried(self, points: Array, to: Self) -> tuple[Array, Array]:
        stretch = to._pixel() / self._pixel()
        return to._corner() + (points - self._corner()) * stretch, np.full(len(points), stretch**2)

    def volume(self) -> float:
        return float(self._cut_out().sum() * self._pixel() ** 2)

    def examine(self) -> list[str]:
        pixels = self._pixels()
        size = f"{pixels.shape[1]} x {pixels.shape[0]} pixels"
        packed = np.ascontiguousarray(pixels).view(np.uint32)[..., 0]
        if (packed == packed[0, 0]).all():
            colour = "are transparent" if pixels[0, 0, 3] < _OPAQUE else f"have the colour {_hex(pixels[0, 0])}"
            raise UsageError(f"{self.path}: an image of one colour, nothing can be cut out: all of its {size} {colour}")
        body = self._cut_out()
        if not body.any():
            other = f"the background {self.background}" if self.background else "white, the background"
            raise UsageError(f"{self.path}: none of its {size} is part of a body: all are transparent or {other}")
        duplicates = [
            name for k, name in enumerate(self.colours) if self.colours[name] in list(self.colours.values())[:k]
        ]
        if duplicates:
            raise UsageError(f"{self.path}: {listed(duplicates)}: its colour has another name too; give each its own")
        nearest = self._nearest()
        absent = [name for k, name in enumerate(self.colours) if not (nearest == k).any()]
        if absent:
            missing = ", ".join(f"'{name}' ({self.colours[name]})" for name in absent)
            common = ", ".join(_most_common(pixels[body]))
            raise UsageError(f"{self.path}: no pixel has the colour {missing}; the most common are {common}")
        return []

    # --- pixels ---------------------------------------------------------------------------------------------

    def _pixels(self) -> Array:
        """Return red, green, blue and alpha (rows, columns, 4), rows from the top."""
        return _read(*self.stamp())

    def _corner(self) -> Array:
        return np.zeros(2) if self.corner is None else np.array(self.corner)

    def _pixel(self) -> float:
        """Return the edge of a pixel [m]."""
        rows, columns, _ = self._pixels().shape
        return self.height / rows if self.height is not None else (self.width or 0.0) / columns

    def _at(self, points: Array, mask: Array) -> Array:
        """Return `mask` (rows, columns) at points (N, 2) [m]; a pixel includes its lower and its left edge."""
        rows, columns = mask.shape
        place = np.floor((points - self._corner()) / self._pixel())
        on_it = ((place >= 0) & (place < [columns, rows])).all(axis=1)
        column, row = place[on_it].astype(int).T
        result = np.zeros(len(points), bool)
        result[on_it] = mask[rows - 1 - row, column]
        return result

    def _far_from(self, colour: str) -> Array:
        """Return the largest difference in red, green and blue from a colour (rows, columns)."""
        far = np.zeros(self._pixels().shape[:2], np.uint8)
        for k, channel in enumerate(np.moveaxis(self._pixels()[..., :3], 2, 0)):
            wanted = np.uint8(int(colour[1 + 2 * k : 3 + 2 * k], 16))
            np.maximum(far, np.maximum(channel, wanted) - np.minimum(channel, wanted), out=far)
        return far

    def _cut_out(self) -> Array:
        """Return which pixels are part of the body (rows, columns)."""
        opaque = self._pixels()[..., 3] >= _OPAQUE
        background = self.background or ("#ffffff" if opaque.all() else None)
        return opaque if background is None else opaque & (self._far_from(background) > self.tolerance)

    def _nearest(self) -> Array:
        """Return the index of each pixel's named colour (rows, columns), -1 for none."""
        body = self._cut_out()
        nearest = np.full(body.shape, -1, np.int32)
        least = np.full(body.shape, self.tolerance + 1, np.int16)
        for k, colour in enumerate(self.colours.values()):  # one after the other: a stack of all would fill the memory
            far = self._far_from(colour)
            nearer = body & (far < least)
            nearest[nearer], least[nearer] = k, far[nearer]
        return nearest


def _hex(pixel: Array) -> str:
    return "#" + "".join(f"{int(c):02x}" for c in pixel[:3])


def _most_common(pixels: Array, count: int = 4) -> list[str]:
    """Return the most common colours of pixels (n, 4), with their shares."""
    red, green, blue = pixels[:, :3].astype(np.uint32).T
    packed = (red << 16) | (green << 8) | blue
    values, counts = np.unique(packed, return_counts=True)
    most = np.argsort(-counts, kind="stable")[:count]
    return [f"#{values[k]:06x} ({counts[k] / len(packed):.1%})" for k in most]


@lru_cache(maxsize=8)
def _read(path: Path, time: int, size: int) -> Array:
    """Read the pixels of a PNG (rows, columns, 4); it is read again when it changes.

    Raises:
        UsageError: it is no PNG, damaged, or too large.
    """
    from PIL import Image as Pillow
    from PIL import UnidentifiedImageError

    try:
        with warnings.catch_warnings(action="ignore"), Pillow.open(path, formats=("PNG",)) as image:
            count = image.width * image.height
            if count > MAX_PIXELS:
                raise UsageError(f"{path}: {image.width} x {image.height} pixels; at most {MAX_PIXELS:,} are read")
            require_memory(path, _PIXEL_MEMORY * count, "save it with fewer pixels")
            pixels = _rgba(image, _bit_depth(path))
    except Pillow.DecompressionBombError:
        raise UsageError(f"{path}: has far too many pixels; at most {MAX_PIXELS:,} are read") from None
    except UnidentifiedImageError:
        raise UsageError(f"{path}: is not a PNG; only PNG is read, whatever a file is called: save it as PNG") from None
    except UsageError:
        raise
    except Exception as error:  # the reader raises many kinds of errors for a broken file
        raise UsageError(f"{path}: cannot be read as PNG: {error}; save it again") from None
    pixels.flags.writeable = False
    return pixels


def _bit_depth(path: Path) -> int:
    """Return the number of bits of a PNG's samples; the first chunk has it behind the width and the height."""
    with path.open("rb") as file:
        return file.read(25)[24]


def _rgba(image: Any, depth: int) -> Array:
    """Return red, green, blue and alpha of a PNG with 8 bits each (rows, columns, 4).

    The file gives its transparent colour with as many bits as its samples have, but Pillow compares it with samples
    that it has scaled to 8 bits, and forgets it where samples of 16 bits are kept.
    """
    clear = image.info.get("transparency")
    if image.mode.startswith("I"):  # grey of 16 bits
        grey = np.asarray(image)
        pixels = np.full((*grey.shape, 4), 255, np.uint8)
        pixels[..., :3] = (grey >> 8)[..., None]
        if clear is not None:
            pixels[grey == clear, 3] = 0
        return pixels
    if image.mode == "L" and clear is not None:
        image.info["transparency"] = clear * 255 // (2**depth - 1)
    elif image.mode == "RGB" and clear is not None and depth == 16:
        image.info["transparency"] = tuple(sample >> 8 for sample in clear)
    return np.array(image.convert("RGBA"))
