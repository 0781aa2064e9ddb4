"""A measured quantity of your own: numbers over time that a scene names, with their gradient.

Here it is the height of a group above a level. Change `values`, and `values_vjp` to its adjoint:
`cqrun gradcheck my_measure.yaml --allow-plugins` checks that the two agree.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from cqrun.measures.measure import BoundMeasure, Measure
from cqrun.observers.matter import A_GROUP, Matter
from cqrun.observers.rows import means
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.reference import BodyName, GroupName
from cqrun.plugin.registry import plugin


@plugin("measure", "my_measure")
class MyMeasure(Measure):
    """Height of a body, or of one of its groups, above a level [m].

    This text is the page of the quantity: `cqrun describe measure my_measure --plugin my_measure.py`.
    """

    body: BodyName = Field(description="Body that is measured")
    group: GroupName | None = Field(description=A_GROUP, default=None)
    level: float = quantity("m", "Height that counts as zero", default=0.0)

    def bind(self, matter: Matter) -> BoundMeasure:
        """Bind this quantity to a scene's particles."""
        return MyHeight(self, matter)


class MyHeight(BoundMeasure):
    """The quantity over the particles of one scene."""

    components = ("",)  # a single number; several have names, such as ("x", "y")
    unit = "m"
    meaning = "height above a level"

    def __init__(self, spec: MyMeasure, matter: Matter) -> None:
        # one row of weights for each sum over particles that is needed: here one mean
        self.rows = means([matter.members(spec.body, spec.group)], matter.n_particles)
        self.level = spec.level
        self.low, self.high = np.zeros(1), matter.size[1:2]  # the usual range, which observers scale to [-1, 1]

    def values(self, track: Track) -> Array:
        """Return the numbers (T + 1, 1), from the start on; track.x is (T + 1, rows, D)."""
        return np.asarray(track.x[:, 0, 1:2] - self.level)

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        """Return the cotangent of the track from that of `values`."""
        x_bar = np.zeros(track.x.shape)
        x_bar[:, 0, 1:2] = bar
        return TrackBar(x=x_bar)
