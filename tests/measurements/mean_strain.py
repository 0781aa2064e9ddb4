"""Mean strain along x of a body or a group, as a strain gauge reads it: a measurement in one file of its own."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import Field

from cqrun.errors import DataError
from cqrun.measurements.comparison import Records
from cqrun.measurements.measurement import Measurement, Recorded
from cqrun.measurements.series import SeriesComparison
from cqrun.observers.matter import A_GROUP, Matter
from cqrun.observers.rows import means
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import GroupName
from cqrun.plugin.registry import plugin


@plugin("measurement", "mean_strain")
class MeanStrain(Measurement):
    """Mean of F_xx - 1 over a body or a group of it; the file is CSV with the columns time [s] and strain [1]."""

    quantity: ClassVar[str] = "strain"
    channel: ClassVar[str] = "gauge"

    group: GroupName | None = Field(description=A_GROUP, default=None)

    def bind(self, recorded: Recorded, matter: Matter) -> SeriesComparison:
        try:
            time, strain = np.loadtxt(recorded.file, delimiter=",", skiprows=1, unpack=True)
        except ValueError as error:
            raise DataError(f"{recorded.file}: no table of times and strains ({error})") from error
        rows = means([matter.members(recorded.body, self.group)], matter.n_particles)
        return Gauge(self, recorded, rows, [self.group or recorded.body], time, strain[:, None, None])


class Gauge(SeriesComparison):
    """One channel with one component, F_xx - 1 of the mean over the particles."""

    def observe(self, records: Records) -> tuple[Array, None]:
        return records.F[:, :, 0, :1] - 1.0, None

    def observe_vjp(self, records: Records, y_bar: Array, w_bar: Array) -> Records:
        bar = records.zeros_like()
        bar.F[:, :, 0, :1] = y_bar
        return bar
