"""How well the grid resolves a body: what lies across its thinnest part."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from cqrun.store.model_file import Part


class Thinnest(Part):
    """The thinnest part of a body: its thickness [m], and the grid cells and particles across it."""

    thickness: float
    cells: float
    particles: float


def thinnest_parts_field() -> Any:
    """Return a field for the thinnest parts of bodies by name; its key is omitted from the file if it is empty."""
    return Field(default_factory=dict, exclude_if=lambda parts: not parts)
