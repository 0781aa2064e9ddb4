"""The sections of a run's report, in their order. To add one, write a function that yields blocks, and add it here."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

from cqrun.report.asked import asked
from cqrun.report.blocks import Block, Section
from cqrun.report.cite import cite
from cqrun.report.found import found
from cqrun.report.gallery import gallery, motion
from cqrun.report.grid import grid
from cqrun.report.measured import measured
from cqrun.report.methods import methods
from cqrun.report.notices import notices
from cqrun.report.provenance import made, scene_and_command
from cqrun.report.quantities import quantities
from cqrun.report.subject import Subject


class Kind(NamedTuple):
    """A kind of section: its name on the page, its heading, and the function that makes its blocks."""

    name: str
    title: str
    blocks: Callable[[Subject], Iterator[Block]]


SECTIONS = (
    Kind("found", "Result", found),
    Kind("quantities", "Measured quantities", quantities),
    Kind("warnings", "Warnings", notices),
    Kind("asked", "What was asked", asked),
    Kind("motion", "Motion", motion),
    Kind("measured", "Measured and predicted", measured),
    Kind("pictures", "Pictures", gallery),
    Kind("grid", "Resolution of the grid", grid),
    Kind("methods", "Methods", methods),
    Kind("scene", "Command and scene", scene_and_command),
    Kind("made", "Machine, time and versions", made),
    Kind("cite", "How to cite", cite),
)
"""All sections; one that has no blocks for a run is left out."""

OF_ALL = {"cite"}
"""Sections that a page of several runs has once."""


def sections_of(subject: Subject) -> list[Section]:
    """Return the sections that a run has.

    Raises:
        UsageError: a file of the run is damaged.
    """
    made = (Section(kind.name, kind.title, list(kind.blocks(subject))) for kind in SECTIONS)
    return [section for section in made if section.blocks]
