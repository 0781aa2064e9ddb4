"""The blocks of a page of the documentation, and how a test runs them.

What stands before a block, in a line of its own, says what the block is:

    `beam.yaml`: (or: Save this as `beam.yaml`:)   a file, with all its content
    <!-- part of: beam.yaml -->               sections that the reader adds to a file (or replaces in it)
    <!-- fast: -o key=value -->               options that the fast test adds, whose output then is not compared
    <!-- skip: why -->                        commands that no test runs
    <!-- exit: 2 -->                          the exit status of the last command, if it is not 0

In a console block, lines with `$` are commands. The others are what they print: numbers may differ by 2 %, `...` stands
for anything, and the folder of a run for any such folder. `RUN` in a command is the run before.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

FENCE = re.compile(r"^```(\{?[\w-]+\}?)[^\n]*\n(.*?)^```$", re.MULTILINE | re.DOTALL)
BEFORE = re.compile(r"(?:^(?:Save this as )?`([\w./-]+)`:|<!-- (part of|fast|skip|exit): (.*?) -->)\s*\Z", re.MULTILINE)
NUMBER = re.compile(r"(?<![\w.])[-+]?\d[\d,]*\.?\d*(?:e[-+]?\d+)?(?![\w])")
RUN = re.compile(r"results/[\w.-]+/[0-9a-f]{12}")
LANGUAGES = {"yaml", "csv", "console", "python", "text", "bibtex"}
TOLERANCE = 0.02


@dataclass(frozen=True)
class Block:
    """A block of a page: its language and text, the file that it is, and what the page says to the test."""

    language: str
    text: str
    file: str
    said: dict[str, str]


def blocks(page: str) -> Iterator[Block]:
    """Yield the blocks of a page in order; those of Sphinx, such as lists of pages, are left out."""
    for fence in FENCE.finditer(page):
        if fence[1].startswith("{"):
            continue
        before, file, said = page[: fence.start()], "", dict[str, str]()
        while found := BEFORE.search(before):
            file = found[1] or file
            said |= {found[2]: found[3]} if found[2] else {}
            before = before[: found.start()]
        yield Block(fence[1], fence[2], file, said)


def commands(text: str) -> Iterator[tuple[str, str]]:
    """Yield the commands of a console block, each with what it is said to print."""
    for part in re.split(r"^\$ ", text, flags=re.MULTILINE)[1:]:
        command, _, output = part.partition("\n")
        while command.endswith("\\"):
            more, _, output = output.partition("\n")
            command = f"{command[:-1]} {more}"
        yield command, output


def differences(expected: str, printed: str) -> str:
    """Return what of an expected output is not in a printed one, or nothing."""
    numbers = [text for part in expected.split("...") for text in NUMBER.findall(RUN.sub("", part))]
    pattern = r"[^\S\n]*" + r".*?".join(map(_pattern, expected.rstrip().split("..."))) + r"[^\S\n]*(?:\n|\Z)"
    found = re.search(pattern, printed, re.DOTALL)
    if not found:
        return f"expected:\n{expected}\nprinted:\n{printed}"
    far = [
        f"{wanted} is said to be printed, not {actual}"
        for wanted, actual in zip(numbers, found.groups(), strict=True)
        if abs(_value(actual) - _value(wanted)) > TOLERANCE * abs(_value(wanted))
    ]
    return "\n".join(far)


def _pattern(text: str) -> str:
    """Return a pattern of text in which each number is a group, and spaces and runs may be others."""
    out, at = "", 0
    text = RUN.sub("\0", text)
    for number in NUMBER.finditer(text):
        out += _words(text[at : number.start()]) + f"({NUMBER.pattern})"
        at = number.end()
    return out + _words(text[at:])


def _words(text: str) -> str:
    escaped = re.escape(text).replace("\0", RUN.pattern)
    return re.sub(r"(?:\\ )+", r"[^\\S\\n]+", escaped)


def _value(text: str) -> float:
    return float(text.replace(",", ""))


def pages(folder: Path) -> list[Path]:
    """Return the pages of the site that have blocks."""
    return [path for path in sorted(folder.rglob("*.md")) if any(blocks(path.read_text("utf-8")))]
