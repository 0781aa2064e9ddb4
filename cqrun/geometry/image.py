"""A body that is cut out of an image."""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from cqrun.errors import UsageError
from cqrun.explain import Loc, complaint, finding, listed, suggest
from cqrun.geometry.file_shape import FileShape
from cqrun.plugin.contract import Array, quantity, vector
from cqrun.plugin.registry import plugin

MAX_PIXELS = 40_000_000
"""A larger image is refused: particles are far coarser."""

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
        wanted = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)])
        return np.abs(self._pixels()[..., :3].astype(int) - wanted).max(axis=2)

    def _cut_out(self) -> Array:
        """Return which pixels are part of the body (rows, columns)."""
        opaque = self._pixels()[..., 3] >= _OPAQUE
        background = self.background or ("#ffffff" if opaque.all() else None)
        return opaque if background is None else opaque & (self._far_from(background) > self.tolerance)

    def _nearest(self) -> Array:
        """Return the index of each pixel's named colour (rows, columns), -1 for none."""
        body = self._cut_out()
        if not self.colours:
            return np.full(body.shape, -1)
        far = np.array([self._far_from(colour) for colour in self.colours.values()])
        return np.where(body & (far.min(axis=0) <= self.tolerance), far.argmin(axis=0), -1)


def _hex(pixel: Array) -> str:
    return "#" + "".join(f"{int(c):02x}" for c in pixel[:3])


def _most_common(pixels: Array, count: int = 4) -> list[str]:
    """Return the most common colours of pixels (n, 4), with their shares."""
    packed = (pixels[:, :3].astype(int) << [16, 8, 0]).sum(axis=1)
    values, counts = np.unique(packed, return_counts=True)
    most = np.argsort(-counts, kind="stable")[:count]
    return [f"#{values[k]:06x} ({counts[k] / len(packed):.1%})" for k in most]


def _eight_bits(image: Any) -> Any:
    """Scale a grey image from 16 bits to 8 bits per pixel; `convert` would clip its values at 255 instead."""
    from PIL import Image as Pillow

    if not image.mode.startswith("I"):
        return image
    return Pillow.fromarray((np.asarray(image).astype(np.int64) >> 8).clip(0, 255).astype(np.uint8))


@lru_cache(maxsize=8)
def _read(path: Path, time: int, size: int) -> Array:
    """Read the pixels of an image file (rows, columns, 4); it is read again when it changes."""
    from PIL import Image as Pillow
    from PIL import UnidentifiedImageError

    try:
        with Pillow.open(path) as image:
            if image.width * image.height > MAX_PIXELS:
                raise UsageError(f"{path}: {image.width} x {image.height} pixels; at most {MAX_PIXELS:.0e} are read")
            pixels = np.asarray(_eight_bits(image).convert("RGBA"))
    except UnidentifiedImageError:
        raise UsageError(f"{path}: is not an image that can be read; save it as PNG") from None
    except (OSError, SyntaxError, ValueError, Pillow.DecompressionBombError) as error:
        raise UsageError(f"{path}: cannot be read as an image: {error}; save it as PNG again") from None
    pixels.flags.writeable = False
    return pixels
