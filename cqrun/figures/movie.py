"""Write pictures to files, completely or not at all: GIF with Pillow, MP4 with ffmpeg, and PNG."""

from __future__ import annotations

import errno
import io
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np

from cqrun.errors import MissingExtra, RunError
from cqrun.plugin.contract import Array
from cqrun.store.atomic import replacing, write_bytes

if TYPE_CHECKING:
    from PIL.Image import Image

COLOURS = 256
"""Number of colours of a GIF; all its pictures have the same palette, so that nothing flickers."""

QUALITY = "18"
"""Constant rate factor of H.264, without visible loss."""


def write_png(path: Path, picture: Array, dpi: float) -> None:
    """Write one picture (h, w, 3) of uint8; raise a UsageError or RunError if it cannot be written."""
    from PIL import Image

    content = io.BytesIO()
    Image.fromarray(picture).save(content, "PNG", dpi=(dpi, dpi), optimize=True)
    write_bytes(path, content.getvalue())


# --- GIF ----------------------------------------------------------------------------------------------------


def gif_delay(fps: float) -> int:
    """Return the duration of a picture in a GIF [ms]: at least two hundredths of a second, in whole hundredths."""
    return max(2, round(100 / fps)) * 10


def write_gif(path: Path, pictures: Iterable[Array], fps: float, samples: Sequence[Array]) -> None:
    """Write pictures (h, w, 3) of uint8 as an endless GIF, with one picture in memory at a time.

    Args:
        path: file to write.
        pictures: the pictures.
        fps: pictures per second.
        samples: some of the pictures, from which the palette is made.

    Raises:
        UsageError, RunError: the file cannot be written.
    """
    from PIL import GifImagePlugin

    palette = _palette(samples)
    delay = gif_delay(fps)
    shown = (_with_palette(picture, palette) for picture in pictures)
    first = next(shown)
    with replacing(path) as temporary, temporary.open("wb") as file:
        header, _ = GifImagePlugin.getheader(first, info={"loop": 0, "duration": delay})
        _write(file, [*header, *GifImagePlugin.getdata(first, duration=delay)])
        before = first
        for image in shown:
            box = _changed(before, image)
            _write(file, GifImagePlugin.getdata(image.crop(box), offset=box[:2], duration=delay))
            before = image
        file.write(b";")


def _write(file: IO[bytes], pieces: Iterable[bytes]) -> None:
    for piece in pieces:
        file.write(piece)


def _palette(samples: Sequence[Array]) -> Image:
    """Return an image with a palette that fits the samples; its last colour is white."""
    from PIL import Image

    quantized = Image.fromarray(np.concatenate(samples)).quantize(COLOURS - 1, method=Image.Quantize.MEDIANCUT)
    palette = Image.new("P", (1, 1))
    colours = (quantized.getpalette() or [])[: 3 * (COLOURS - 1)]
    palette.putpalette(colours + [255] * (3 * COLOURS - len(colours)))
    return palette


def _with_palette(picture: Array, palette: Image) -> Image:
    from PIL import Image

    index = np.array(Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE))
    index[(picture[..., 0] & picture[..., 1] & picture[..., 2]) == 255] = (
        COLOURS - 1
    )  # Pillow would replace white by a nearly white colour
    image = Image.fromarray(index)
    image.putpalette(palette.getpalette() or [])
    return image


def _changed(before: Image, after: Image) -> tuple[int, int, int, int]:
    """Return the box in which two pictures with one palette differ; one pixel if they are equal."""
    differs = np.asarray(before) != np.asarray(after)
    rows, columns = np.flatnonzero(differs.any(axis=1)), np.flatnonzero(differs.any(axis=0))
    if not rows.size:
        return 0, 0, 1, 1
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


# --- MP4 ----------------------------------------------------------------------------------------------------


def ffmpeg() -> str:
    """Return the path of ffmpeg.

    Raises:
        MissingExtra: the extra `video` is not installed.
    """
    try:
        import imageio_ffmpeg
    except ModuleNotFoundError:
        raise MissingExtra(
            "--mp4 needs imageio-ffmpeg, which is not installed: pip install 'cqrun[video]'; --gif works without it"
        ) from None
    try:
        return str(imageio_ffmpeg.get_ffmpeg_exe())
    except RuntimeError as error:
        raise MissingExtra(f"--mp4 needs ffmpeg: {error}") from None


def write_mp4(path: Path, pictures: Iterable[Array], fps: float) -> None:
    """Write pictures (h, w, 3) of uint8, with even h and w, as H.264 in MP4, by streaming them to ffmpeg.

    Raises:
        MissingExtra: the extra `video` is not installed.
        UsageError, RunError: the file cannot be written.
    """
    program = ffmpeg()
    stream = iter(pictures)
    first = next(stream)
    height, width, _ = first.shape
    with replacing(path) as temporary:
        source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:g}", "-i", "-"]
        kind = ["-c:v", "libx264", "-crf", QUALITY, "-pix_fmt", "yuv420p", "-movflags", "+faststart", "-f", "mp4"]
        words = [program, "-y", "-loglevel", "error", "-nostats", *source, *kind, str(temporary)]
        # in a new session, so that Ctrl-C reaches only cqrun, which then ends ffmpeg
        process = subprocess.Popen(words, stdin=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True)
        try:
            _feed(process, chain([first], stream))
        except BaseException:
            process.kill()
            process.communicate()
            raise
        _, stderr = process.communicate()
        if process.returncode != 0:
            raise _failure(path, stderr.decode(errors="replace"))


def _feed(process: subprocess.Popen[bytes], pictures: Iterator[Array]) -> None:
    assert process.stdin is not None
    for picture in pictures:
        try:
            process.stdin.write(np.ascontiguousarray(picture).tobytes())
        except BrokenPipeError:
            return  # ffmpeg has ended and reports the reason


def _failure(path: Path, stderr: str) -> Exception:
    if "No space left" in stderr:
        return OSError(errno.ENOSPC, "No space left on device")
    lines = stderr.strip().splitlines() or ["it gives no reason"]
    return RunError(f"{path}: ffmpeg failed: {lines[-1]}")
