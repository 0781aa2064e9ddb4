"""The memory that is free, and what to say if it is too little."""

from __future__ import annotations

from cqrun.units import format_bytes


def shortage(what: str, need: float, advice: str) -> str:
    """Return an error message if something needs more memory than is free, else an empty text.

    Args:
        what: what needs it, with its verb, such as `1000 images need`.
        need: how much [bytes].
        advice: what to do then.
    """
    import psutil

    free = psutil.virtual_memory().available
    return "" if need <= free else f"{what} {format_bytes(need)}; {format_bytes(free)} are free: {advice}"
