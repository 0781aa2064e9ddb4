"""Characters that terminals, YAML or eyes take for something else, and names for them."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator

_TYPE = {
    "\N{MINUS SIGN}": "-", "\N{HYPHEN}": "-", "\N{NON-BREAKING HYPHEN}": "-", "\N{FIGURE DASH}": "-",
    "\N{EN DASH}": "-", "\N{EM DASH}": "-", "\N{HORIZONTAL BAR}": "-", "\N{HYPHEN BULLET}": "-",
    "\N{SMALL HYPHEN-MINUS}": "-", "\N{LEFT DOUBLE QUOTATION MARK}": '"', "\N{RIGHT DOUBLE QUOTATION MARK}": '"',
    "\N{DOUBLE LOW-9 QUOTATION MARK}": '"', "\N{LEFT SINGLE QUOTATION MARK}": "'",
    "\N{RIGHT SINGLE QUOTATION MARK}": "'", "\N{DIVISION SLASH}": "/", "\N{RATIO}": ":",
    "\N{MODIFIER LETTER COLON}": ":", "\N{ARABIC DECIMAL SEPARATOR}": ".",
}  # fmt: skip
"""Characters that are not compatibility forms of what they look like, and what to type instead."""


_CONTROL = frozenset({"Cc", "Cs", "Zl", "Zp"})
"""Categories of characters that are no part of any text: control characters, line breaks, halves of characters."""

_TURNING = frozenset("\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")
"""Characters that turn the direction of what follows, so that it reads as something else."""


def controls(character: str) -> bool:
    """Return whether a character changes what a terminal shows, instead of being shown."""
    return unicodedata.category(character) in _CONTROL or character in _TURNING


def printable(text: str) -> str:
    r"""Return one line: a text in which all characters that cannot be seen, but spaces, are escaped, as in `\x1b`."""
    return "".join(c if c.isprintable() or _is_byte(c) else _escaped(c) for c in text)


def harmless(text: str) -> str:
    r"""Return lines for a terminal: a text in which all characters that control it, but line feeds, are escaped."""
    return "".join(_escaped(c) if controls(c) and c != "\n" and not _is_byte(c) else c for c in text)


def _is_byte(character: str) -> bool:
    """Return whether Python made a character of a byte that is not UTF-8, as in a file's name; no control character."""
    return "\udca0" <= character <= "\udcff"


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")


def instead_of(character: str) -> str | None:
    """Return the ASCII character that one looks like, an empty text for one without a width, or None."""
    if character.isascii():
        return None
    if character in _TYPE:
        return _TYPE[character]
    if unicodedata.category(character) in ("Cf", "Cc"):
        return ""
    plain = unicodedata.normalize("NFKC", character)  # full-width forms, spaces of other widths, digits in bold
    plain = " " if plain.isspace() else plain
    return plain if len(plain) == 1 and plain.isascii() else _digit(character)


def _digit(character: str) -> str | None:
    """Return the digit that a digit of another script stands for."""
    return str(unicodedata.decimal(character)) if character.isdecimal() else None


def plain(text: str) -> str:
    """Return a text with all characters replaced by the ASCII characters that they look like."""
    return "".join(c if (other := instead_of(c)) is None else other for c in text)


def lookalikes(text: str) -> Iterator[tuple[int, str]]:
    """Yield the index of each character that looks like an ASCII character or like nothing, and what it is in words."""
    for k, character in enumerate(text):
        if (other := instead_of(character)) is not None:
            name = unicodedata.name(character, "control character").lower()
            of = {"": "that is not visible", " ": "instead of a space"}.get(other, f"instead of {other}")
            yield k, f"{_article(name)} {name} (U+{ord(character):04X}) {of}"


def _article(name: str) -> str:
    return "an" if name[0] in "aeio" else "a"


_NUMBER = re.compile(r"[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:e[-+]?[0-9]+)?")


def number_meant(text: str) -> str | None:
    """Return the number that a text was probably meant to be, as YAML writes it, or None."""
    candidate = re.sub(r"[\s_]", "", plain(text)).lower()
    candidate = re.sub(r"d(?=[-+]?[0-9]+$)", "e", candidate)  # Fortran's exponent
    if re.fullmatch(r"[-+]?[0-9]+,[0-9]+(?:e[-+]?[0-9]+)?", candidate) and not re.search(r"[1-9],[0-9]{3}$", candidate):
        candidate = candidate.replace(",", ".")  # but 1,000 is a thousand for some and one for others
    return candidate if _NUMBER.fullmatch(candidate) else None
