"""Characters that look like others are named, and those that control terminals are shown."""

from __future__ import annotations

import pytest

from cqrun.characters import harmless, lookalikes, number_meant, printable


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("\N{MINUS SIGN}9.81", "-9.81"),
        ("\N{EN DASH}1e5", "-1e5"),
        ("\N{FULLWIDTH DIGIT ONE}\N{FULLWIDTH DIGIT TWO}", "12"),
        ("\N{ARABIC-INDIC DIGIT THREE}", "3"),
        ("\N{NO-BREAK SPACE}0.02", "0.02"),
        ("1\N{NARROW NO-BREAK SPACE}000", "1000"),
        ("\N{ZERO WIDTH SPACE}5", "5"),
        ("0,1", "0.1"),
        ("0,125", "0.125"),
        ("5.0d4", "5.0e4"),
        ("50_000", "50000"),
        ("0.02", "0.02"),
        ("1,000", None),
        ("0.02 m", None),
        ("1/50", None),
        ("e5", None),
        ("", None),
    ],
)
def test_the_number_that_a_text_was_meant_to_be(text: str, number: str | None) -> None:
    assert number_meant(text) == number


@pytest.mark.parametrize(
    "text", ["plain: [1, 2]", "\u00e9\u00df\u7532", "\N{DEGREE SIGN}", "1\N{VULGAR FRACTION ONE HALF}"]
)
def test_other_characters_are_what_they_look_like(text: str) -> None:
    assert list(lookalikes(text)) == []


def test_what_cannot_be_seen_is_shown() -> None:
    text = "a\x1b[2J\r\n\N{NO-BREAK SPACE}\N{RIGHT-TO-LEFT OVERRIDE}\N{LINE SEPARATOR}\udc9b\udce9\u00e9"
    assert printable(text) == r"a\x1b[2J\r\n\xa0\u202e\u2028\udc9b" + "\udce9é"
    assert harmless(text) == "a\\x1b[2J\\r\n\N{NO-BREAK SPACE}\\u202e\\u2028\\udc9b\udce9é"
