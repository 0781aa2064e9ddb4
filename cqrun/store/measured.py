"""Measured quantities of a run: in a table, in a trajectory and as a summary.

measurements.csv      one row per control step (at rest: per point, row 0 is the rest shape); a column is called by its
                      quantity, and by its component if it has several: tip.x; an empty cell has no value
/measured/time (T) f8 and /measured/quantities/NAME (T, n) f8 in trajectory.h5, with the attributes `unit`, `long_name`
                      and `components`; /checksums/measured/... (T) u4: CRC-32 of each row
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cqrun.plugin.contract import Array
from cqrun.store.atomic import write_table
from cqrun.store.hdf5 import checksum, member, numbers, text
from cqrun.store.model_file import Part

if TYPE_CHECKING:
    import h5py

GROUP, TIME, TABLE = "measured", "time", "measurements.csv"


class MeasuredNumber(Part):
    """One number of a measured quantity over a run: its unit, values at the start and the end, extremes and mean."""

    unit: str
    start: float
    end: float
    least: float
    largest: float
    mean: float


@dataclass(frozen=True)
class Quantity:
    """A measured quantity over time.

    Attributes:
        values: (T, n), NaN where it has no value.
        components: name of each of the n numbers; a single empty name for one number.
        unit: SI unit.
        meaning: what it is, in words.
    """

    values: Array
    components: tuple[str, ...]
    unit: str
    meaning: str

    def names(self, name: str) -> list[str]:
        """Return the name of each number of a quantity called `name`."""
        return [f"{name}.{component}" if component else name for component in self.components]


@dataclass(frozen=True)
class MeasuredQuantities:
    """The measured quantities of a run.

    Attributes:
        time: (T,) [s]; at rest the number of each point.
        quantities: by name.
        at_rest: whether rows are points at rest.
    """

    time: Array
    quantities: dict[str, Quantity] = field(default_factory=dict)
    at_rest: bool = False

    def columns(self) -> dict[str, tuple[Array, str]]:
        """Return the values (T,) and the unit of every number, by its name."""
        return {
            name: (values, quantity.unit)
            for owner, quantity in self.quantities.items()
            for name, values in zip(quantity.names(owner), quantity.values.T, strict=True)
        }

    def summary(self) -> dict[str, MeasuredNumber]:
        """Return the summary of every number that has values, by its name."""
        out = {}
        for name, (values, unit) in self.columns().items():
            known = values[np.isfinite(values)]
            if len(known):
                ends = {"start": known[0], "end": known[-1], "least": known.min(), "largest": known.max()}
                ends["mean"] = known.mean()
                out[name] = MeasuredNumber(unit=unit, **{key: float(value) for key, value in ends.items()})
        return out

    def write_table(self, path: Path) -> None:
        """Write the table; RunError if the disk is full."""
        columns = self.columns()
        rows = np.column_stack([self.time, *(values for values, _ in columns.values())]).tolist()
        head = ["point" if self.at_rest else "time", *columns]
        if self.at_rest:
            rows = [[int(first), *rest] for first, *rest in rows]
        write_table(path, [head, *([_cell(value) for value in row] for row in rows)])

    @property
    def nbytes(self) -> int:
        """Size of all numbers [bytes], with checksums and names."""
        return self.time.nbytes + sum(q.values.nbytes + 4 * len(q.values) + 4096 for q in self.quantities.values())

    def write_to(self, file: h5py.File) -> None:
        """Write the quantities to a trajectory."""
        _put(file, TIME, self.time, "1" if self.at_rest else "s", "number of the point" if self.at_rest else "time")
        file[GROUP].attrs["names"] = json.dumps(list(self.quantities))
        for name, quantity in self.quantities.items():
            data = _put(file, f"quantities/{name}", quantity.values, quantity.unit, quantity.meaning)
            data.attrs["components"] = json.dumps(quantity.components)


def _cell(value: float) -> object:
    return "" if value != value else repr(value) if isinstance(value, float) else value


def _put(file: h5py.File, name: str, array: Array, unit: str, meaning: str) -> h5py.Dataset:
    place = f"{GROUP}/{name}"
    file[place] = np.ascontiguousarray(array, "f8")
    file[place].attrs["unit"], file[place].attrs["long_name"] = unit, meaning
    file[f"checksums/{place}"] = np.array([checksum(row) for row in np.asarray(array, "f8")], np.uint32)
    return file[place]


def read_measured(file: h5py.File) -> MeasuredQuantities | None:
    """Return the measured quantities in a trajectory; None if it has none.

    Raises:
        ValueError: they are not what was written.
    """
    if GROUP not in file:
        return None
    time = _read(file, TIME)
    found = {}
    for name in json.loads(text(member(file, GROUP), "names")):
        data = numbers(file, f"{GROUP}/quantities/{name}")
        components = tuple(str(part) for part in json.loads(text(data, "components")))
        values = _read(file, f"quantities/{name}", len(time))
        if values.shape != (len(time), len(components)):
            raise ValueError(f"'{name}' has {values.shape[-1]} numbers for {len(components)} components")
        found[name] = Quantity(values, components, text(data, "unit"), text(data, "long_name"))
    return MeasuredQuantities(time, found, text(numbers(file, f"{GROUP}/{TIME}"), "unit") == "1")


def _read(file: h5py.File, name: str, rows: int | None = None) -> Array:
    place = f"{GROUP}/{name}"
    array: Array = numbers(file, place)[:]
    sums = numbers(file, f"checksums/{place}")[:]
    if len(sums) != len(array) or rows not in (None, len(array)):
        raise ValueError(f"'{place}' has {len(array)} rows of {rows or len(sums)}")
    for number, row in enumerate(array):
        if checksum(row) != sums[number]:
            raise ValueError(f"row {number} of '{place}' is not what was written")
    return array
