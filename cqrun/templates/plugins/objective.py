"""An objective of your own: it turns a motion into one number.

Here it is how far a group of particles gets along x. Change `steps`, and `steps_vjp` to its adjoint:
`cqrun gradcheck my_objective.yaml --allow-plugins` checks that the two agree.
"""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from cqrun.objectives.term import BoundTerm, ObjectiveTerm
from cqrun.observers.matter import A_GROUP, Matter
from cqrun.observers.rows import means
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import BodyName, GroupName
from cqrun.plugin.registry import plugin


@plugin("objective", "my_objective")
class MyObjective(ObjectiveTerm):
    """Displacement of a body, or of one of its groups, along x since the start [m]. Larger is better.

    This text is the page of the objective: `cqrun describe objective my_objective --plugin my_objective.py`.
    """

    sense: ClassVar[Literal[1, -1]] = -1  # 1 if smaller is better

    body: BodyName = Field(description="Body that moves")
    group: GroupName | None = Field(description=A_GROUP, default=None)

    def bind(self, matter: Matter) -> BoundTerm:
        """Bind this term to a scene's particles."""
        return MyTerm(self, matter)


class MyTerm(BoundTerm):
    """The term over the particles of one scene."""

    def __init__(self, spec: MyObjective, matter: Matter) -> None:
        # one row of weights for each sum over particles that is needed: here one mean
        self.rows = means([matter.members(spec.body, spec.group)], matter.n_particles)
        self.over = spec.over

    def steps(self, track: Track) -> Array:
        """Return the value at the end of every control step (T,); track.x is (T + 1, rows, D), from the start on."""
        return np.asarray(track.x[1:, 0, 0] - track.x[0, 0, 0])

    def steps_vjp(self, track: Track, h_bar: Array) -> TrackBar:
        """Return the cotangent of the track from that of `steps`."""
        x_bar = np.zeros(track.x.shape)
        x_bar[1:, 0, 0] = h_bar
        x_bar[0, 0, 0] = -h_bar.sum()
        return TrackBar(x=x_bar)
