"""What a page consists of: sections, and the kinds of blocks in them; page.html.j2 shows each kind.

A section's function makes these blocks from plain texts and numbers. Nothing here is HTML: the template escapes all
texts.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Literal

MOST_ROWS = 200
"""Rows that a table on a page has at most; the files of the run have all."""

NUMBER = re.compile(r"[+-]?[0-9][0-9,]*(\.[0-9]+)?(e[+-]?[0-9]+)?( |%|$)")
"""The beginning of a cell that is aligned like a number: `0.36`, `1.2e+05 Pa`, `3 to 5`."""

MOST_SENTENCES = 100
"""Warnings that a page shows at most."""


@dataclass(frozen=True)
class Link:
    """A text that leads to another file, relative to the page, or to a section of it (`#name`)."""

    text: str
    href: str


Cell = str | Link


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    form: ClassVar[str] = "text"
    words: str


@dataclass(frozen=True)
class Facts:
    """Names and what is known of each."""

    form: ClassVar[str] = "facts"
    rows: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Number:
    """A result in large type: what it is, the number with its unit, and a line about it."""

    label: str
    value: str
    detail: str = ""


@dataclass(frozen=True)
class Numbers:
    """The most important numbers of a run."""

    form: ClassVar[str] = "numbers"
    each: Sequence[Number]


@dataclass(frozen=True)
class Table:
    """A table; columns whose cells are all numbers are aligned to the right.

    Attributes:
        head: a name for each column.
        rows: the cells of each row.
        caption: what the table shows.
        rest: where the other rows are, if it has too many.
    """

    form: ClassVar[str] = "table"
    head: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    caption: str = ""
    rest: str = "in the files of the run"

    @property
    def shown(self) -> Sequence[Sequence[Cell]]:
        """The rows that the page shows."""
        return self.rows[:MOST_ROWS]

    @property
    def left_out(self) -> int:
        """The number of rows that it does not show."""
        return len(self.rows) - len(self.shown)

    @property
    def columns(self) -> list[int]:
        """The columns that the page shows: the first, and all that are not empty."""
        return [k for k in range(len(self.head)) if k == 0 or any(row[k] for row in self.rows if k < len(row))]

    @property
    def styles(self) -> list[str]:
        """The CSS class of each column: `n` for numbers, `w` for long texts."""
        return [_style([row[k] for row in self.shown if k < len(row)]) for k in range(len(self.head))]


def _style(cells: Sequence[Cell]) -> str:
    texts = [cell if isinstance(cell, str) else cell.text for cell in cells]
    if any(texts) and all(text in ("", "-") or NUMBER.match(text) for text in texts):
        return "n"
    return "w" if any(len(text) > 28 for text in texts) else ""


@dataclass(frozen=True)
class Notes:
    """Sentences that a reader must not miss; `mild` if nothing is wrong."""

    form: ClassVar[str] = "notes"
    sentences: Sequence[str]
    mild: bool = False

    @property
    def shown(self) -> Sequence[str]:
        """The sentences that the page shows."""
        return self.sentences[:MOST_SENTENCES]

    @property
    def left_out(self) -> int:
        """The number of sentences that it does not show."""
        return len(self.sentences) - len(self.shown)


@dataclass(frozen=True)
class Picture:
    """A picture or a film in a file, which becomes part of the page.

    Attributes:
        path: a PNG or GIF.
        alt: what it shows, for readers who do not see it.
        caption: a line below it.
        wide: whether it takes the whole width of the page.
    """

    form: ClassVar[str] = "picture"
    path: Path
    alt: str
    caption: str = ""
    wide: bool = True


@dataclass(frozen=True)
class Code:
    """Text that is shown as it is, such as a scene or a command."""

    form: ClassVar[str] = "code"
    text: str


@dataclass(frozen=True)
class Folded:
    """Blocks that are shown when a reader asks for them."""

    form: ClassVar[str] = "folded"
    title: str
    blocks: Sequence[Block]


Block = Text | Facts | Numbers | Table | Notes | Picture | Code | Folded


@dataclass(frozen=True)
class Section:
    """A part of a page with a heading; `name` identifies it on the page."""

    name: str
    title: str
    blocks: Sequence[Block]


Mood = Literal["good", "mixed", "bad"]
"""Whether what a page reports is a success."""


@dataclass(frozen=True)
class Page:
    """A page.

    Attributes:
        title: its heading.
        lead: a line below the heading.
        badge: a word on how it ended.
        mood: whether that is `good`, `mixed` or `bad`.
        sections: its parts.
    """

    title: str
    lead: str
    badge: str
    mood: Mood
    sections: Sequence[Section] = field(default_factory=tuple)


def pictures(blocks: Sequence[Block]) -> list[Picture]:
    """Return all pictures among blocks, and in folded ones."""
    found: list[Picture] = []
    for block in blocks:
        if isinstance(block, Picture):
            found.append(block)
        elif isinstance(block, Folded):
            found += pictures(block.blocks)
    return found
