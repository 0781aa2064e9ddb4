"""Base of measurements: a measurement is a plug-in that reads a recording and compares a model with it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from cqrun.measurements.comparison import Comparison
from cqrun.measurements.placement import Placement
from cqrun.measurements.recording import Recording
from cqrun.measurements.window import Window
from cqrun.observers.matter import Matter
from cqrun.plugin.contract import Plugin
from cqrun.units import Unit


@dataclass(frozen=True)
class Recorded:
    """A recording as the scene describes it, for a measurement to read.

    Attributes:
        file: path of the file.
        body: the body that was measured.
        units: length unit of the file, or None.
        still: first and last time of the frames at rest [s], or None.
        weight: weight in the loss.
        window: which frames are compared.
        read_markers: reads the named markers of a marker file of any format, or all of them if no names are given;
            DataError if the file is not one, or does not contain a name.
        placement: of measured positions in the axes of the scene before the fit changes it, or None.
    """

    file: Path
    body: str
    window: Window
    read_markers: Callable[..., Recording]
    units: str | None = None
    still: tuple[float, float] | None = None
    weight: float = 1.0
    placement: Placement | None = None


class Measurement(Plugin):
    """Base of the plug-ins of kind `measurement`, whose names are keys of a recording.

    Attributes:
        quantity: name of the measured quantity in pictures.
        unit: SI unit of the residuals; `1` if they have none.
        shown: unit in which errors are reported.
        digits: format of reported errors.
        channel: name for the source of each series, such as `marker`.
        table: stem of the CSV file with data and model; the plug-in's name if empty.
        takes: which of the recording's fields `still`, `units`, `offset` and `rotation` it uses; the others are
            refused. One that takes `offset` and `rotation` returns a comparison that can be `placed`.
        at_rest: whether the model is compared in equilibria and not in motion; then times have no meaning (at_rest.py).
    """

    quantity: ClassVar[str]
    unit: ClassVar[str] = "1"
    shown: ClassVar[Unit] = Unit("", 1.0)
    digits: ClassVar[str] = ".4g"
    channel: ClassVar[str] = "channel"
    table: ClassVar[str] = ""
    takes: ClassVar[frozenset[str]] = frozenset()
    at_rest: ClassVar[bool] = False

    @property
    def compares_rest(self) -> bool:
        """Whether this one compares equilibria; a measurement that is `at_rest` may also compare a motion."""
        return self.at_rest

    @property
    def boundaries(self) -> tuple[str, ...]:
        """The boundaries whose force and moment in motion it needs."""
        return ()

    @property
    def table_name(self) -> str:
        """Name of the file with data and model."""
        return self.table_file()

    @abstractmethod
    def bind(self, recorded: Recorded, matter: Matter) -> Comparison:
        """Return the comparison of a recording with a scene's particles.

        Raises:
            UsageError: the file cannot be used, or does not fit the scene.
        """

    @classmethod
    def table_file(cls) -> str:
        """Return the name of the file with data and model."""
        return f"{cls.table or cls.name}.csv"

    @classmethod
    def error_key(cls, word: str) -> str:
        """Return a key of result.json for errors, with their unit: `rmse_mm`."""
        return f"{word}_{cls.shown.name}" if cls.shown.name else word
