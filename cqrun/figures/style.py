"""The style of all pictures, and how they are saved: completely or not at all.

Pictures are made without pyplot, so there is no window and no state between two of them. Draw and save inside
`styled()`.
"""

from __future__ import annotations

import io
import re
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cqrun.figures.quantities import time_unit
from cqrun.plugin.contract import Array
from cqrun.store.atomic import write_bytes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#6A51A3", "#8C6D31")
"""Colours that colour-blind readers can distinguish (Okabe and Ito, without yellow, which is too pale for lines)."""

INK, GREY, PALE = "#222222", "#6E6E6E", "#D9D9D9"
TRUTH = "#C00000"
GROUND = "#DADADA"

AMOUNT_MAP, SIGNED_MAP = "viridis", "coolwarm"
"""Colour maps of quantities from 0 on and of signed quantities; colour-blind readers can read both."""

PASSIVE = "#B4B4B4"
"""Colour of particles that have no value of the quantity shown."""

STYLE: dict[str, Any] = {
    "figure.dpi": 130,
    "savefig.dpi": 130,
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 8.5,
    "axes.labelcolor": INK,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#ECECEC",
    "grid.linewidth": 0.7,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "lines.linewidth": 1.5,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "legend.title_fontsize": 8,
    "pdf.fonttype": 42,
    "figure.constrained_layout.h_pad": 0.06,
    "figure.constrained_layout.w_pad": 0.06,
}

FEW_DECADES = 2.5
"""Logarithmic axes of fewer decades than this are labelled at 1, 2 and 5 times the powers of ten."""

LONG_TITLE = 36
"""Titles with more letters than this are smaller."""

TITLE_LINE = 48
"""Largest number of letters in a line of a title."""

NARROW = 3.0
"""Logarithmic axes whose ends differ by less than this factor are labelled at round numbers, like linear axes."""


@contextmanager
def styled(*, formulas: bool = False) -> Iterator[None]:
    """Draw and save in cqrun's style, independent of the user's settings.

    Args:
        formulas: read what is between two dollars as a formula; the names in users' files are drawn as they are.
    """
    import matplotlib
    from cycler import cycler

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(STYLE | {"text.parse_math": formulas})
        matplotlib.rcParams["axes.prop_cycle"] = cycler(color=COLOURS)
        yield


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size [inch]."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def save(figure: Figure, base: Path, kinds: Sequence[str] = ("png",), keywords: str = "") -> list[Path]:
    """Write `base` with a suffix for each kind, png or pdf; return the paths.

    Args:
        figure: the picture.
        base: path without the suffix.
        kinds: png, pdf.
        keywords: keywords in the metadata of the file, stored as plain text.

    Raises:
        UsageError: the directory cannot be written to.
        RunError: the disk is full.
    """
    written = []
    for kind in kinds:
        content = io.BytesIO()
        stamp = {"CreationDate": None} if kind == "pdf" else {}  # so that equal pictures are equal files
        metadata = {"Keywords": keywords} if keywords else {}
        figure.savefig(content, format=kind, metadata=stamp | metadata)
        path = base.with_name(f"{base.name}.{kind}")
        write_bytes(path, content.getvalue())
        written.append(path)
    return written


def whole_ticks(axis: Axis) -> None:
    """Put an axis' ticks on whole numbers."""
    from matplotlib.ticker import MaxNLocator

    axis.set_major_locator(MaxNLocator(nbins=6, integer=True))


def clock_ticks(axis: Axis, iteration: Array, seconds: Array, last: float = 0.0) -> str:
    """Write the wall time [s] below each iteration; return its unit.

    An axis that continues to `last` has ticks without times there, and one where the iterations end.
    """
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    unit = time_unit(float(seconds[-1]))
    digits = 0 if unit.factor * float(seconds[-1] - seconds[0]) >= 10 else 1

    def text(tick: float, _: int) -> str:
        if not iteration[0] <= tick <= iteration[-1]:
            return f"{tick:g}\n" if iteration[-1] < tick <= last else ""
        return f"{tick:g}\n{unit.factor * np.interp(tick, iteration, seconds):.{digits}f}"

    if last > iteration[-1]:
        few = MaxNLocator(max(1, round(5 * iteration[-1] / last)), integer=True).tick_values(*iteration[[0, -1]])
        axis.set_ticks([*(tick for tick in few if tick < 0.9 * iteration[-1]), iteration[-1], last])
    axis.set_major_formatter(FuncFormatter(text))
    return unit.name


def log_ticks(axis: Axis, low: float, high: float) -> None:
    """Give a logarithmic axis from low to high readable ticks, however short it is."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

    span = np.log10(high / low)
    if high / low < NARROW:
        axis.set_major_locator(MaxNLocator(nbins=5, steps=[1, 2, 2.5, 5, 10]))
        axis.set_minor_locator(NullLocator())
    elif span < FEW_DECADES:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if span > 1.0 else (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)))
        axis.set_minor_locator(NullLocator())
    else:
        axis.set_major_locator(LogLocator(numticks=7))
    axis.set_major_formatter(FuncFormatter(lambda value, _: tick_text(value)))
    axis.set_minor_formatter(NullFormatter())


def tick_text(value: float) -> str:
    """Return a number as short text, such as 250000, 1e6 or 2.5e-7."""
    digits, exponent, power = f"{value:g}".partition("e")
    return f"{digits}e{int(power)}" if exponent else digits


def in_lines(text: str, longest: int) -> str:
    """Return a name in lines of at most `longest` letters, divided after dots, underscores and spaces if possible."""
    lines = [""]
    for piece in re.split(r"(?<=[._ ])", text):
        if lines[-1] and len(lines[-1]) + len(piece.rstrip()) > longest:
            lines.append("")
        lines[-1] += piece
    return "\n".join(line.rstrip() for line in lines)


def note(axes: Axes, text: str) -> None:
    """Write a small grey line between an axes' title and the axes."""
    line = axes.annotate(
        text, (0, 1), xycoords="axes fraction", xytext=(0, 3), textcoords="offset points",
        fontsize=7.5, color=GREY, va="bottom", ha="left", annotation_clip=False,
    )  # fmt: skip
    line.set_in_layout(False)  # a long line must not make the axes smaller


def legend_label(name: str) -> str:
    """Return a user's name as a label; matplotlib leaves labels that begin with an underscore out of legends."""
    return f" {name}" if name.startswith("_") else name


def titled(axes: Axes, title: str, text: str = "") -> None:
    """Give an axes a title and, below it, a small grey line."""
    size = None if len(title) <= LONG_TITLE else 7.5
    axes.set_title("\n".join(textwrap.wrap(title, TITLE_LINE)), pad=15 if text else 6, fontsize=size)
    if text:
        note(axes, text)
