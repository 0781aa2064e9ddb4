"""Amounts of memory, as people write them."""

from __future__ import annotations

import pytest

from cqrun.units import format_bytes, parse_bytes


@pytest.mark.parametrize(
    ("text", "count"),
    [("2GiB", 2**31), ("500MB", 500_000_000), ("1.5 KiB", 1536), ("7B", 7), (" .5kB ", 500)],
)
def test_amounts_are_read(text: str, count: int) -> None:
    assert parse_bytes(text) == count


@pytest.mark.parametrize("text", ["2", "GiB", "2gib", "-1GB", "2 G", "1e3MB", "", "9" * 400 + "GB"])
def test_text_that_is_no_amount_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="must be an amount of memory such as 2GiB"):
        parse_bytes(text)


def test_amounts_are_shown_in_the_largest_unit() -> None:
    assert [format_bytes(n) for n in (0, 1023, 2**10, 3 * 2**29, 2**41)] == [
        "0 B",
        "1023 B",
        "1 KiB",
        "1.5 GiB",
        "2 TiB",
    ]
