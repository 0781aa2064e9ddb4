"""A measurement of your own: what a recording contains, and how the model is compared with it.

Here it is the mean strain of a body along x, as a strain gauge reads it. Change `bind` to read your file, and `observe`
to what the model would have measured; `observe_vjp` is its adjoint, and
`cqrun gradcheck my_measurement.yaml --allow-plugins` checks that the two agree.
"""

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


@plugin("measurement", "my_measurement")
class MyMeasurement(Measurement):
    """Mean of F_xx - 1 over a body or one of its groups; the file is CSV with the columns time [s] and strain [1].

    This text is the page of the measurement: `cqrun describe measurement my_measurement --plugin my_measurement.py`.
    """

    quantity: ClassVar[str] = "strain"  # in pictures
    channel: ClassVar[str] = "gauge"

    group: GroupName | None = Field(description=A_GROUP, default=None)

    def bind(self, recorded: Recorded, matter: Matter) -> SeriesComparison:
        """Read the file, and return its comparison with a scene's particles."""
        try:
            time, strain = np.loadtxt(recorded.file, delimiter=",", skiprows=1, unpack=True)
        except (OSError, ValueError) as error:
            raise DataError(f"{recorded.file}: no table of times and strains ({error})") from error
        rows = means([matter.members(recorded.body, self.group)], matter.n_particles)
        return MyComparison(self, recorded, rows, [self.group or recorded.body], time, strain[:, None, None])


class MyComparison(SeriesComparison):
    """One channel with one component."""

    def observe(self, records: Records) -> tuple[Array, None]:
        """Return the model's values (T + 1, channels, components), and their rates if they are known."""
        return records.F[:, :, 0, :1] - 1.0, None

    def observe_vjp(self, records: Records, y_bar: Array, w_bar: Array) -> Records:
        """Return the cotangent of the records from that of the values."""
        bar = records.zeros_like()
        bar.F[:, :, 0, :1] = y_bar
        return bar
