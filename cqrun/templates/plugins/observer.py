"""An observer of your own: what a controller sees in every control step.

Here it is the velocity of a group of particles. Change `observe`, and `observe_vjp` to its adjoint:
`cqrun gradcheck my_observer.yaml --allow-plugins` checks that the two agree.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from cqrun.observers.matter import A_GROUP, Matter
from cqrun.observers.observer import BoundObserver, Moment, MomentBar, Observer
from cqrun.observers.rows import means
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.reference import BodyName, GroupName
from cqrun.plugin.registry import plugin


@plugin("observer", "my_observer")
class MyObserver(Observer):
    """Mean velocity of the particles of a body, or of one of its groups [m/s].

    This text is the page of the observer: `cqrun describe observer my_observer --plugin my_observer.py`.
    """

    body: BodyName = Field(description="Body that is observed")
    group: GroupName | None = Field(description=A_GROUP, default=None)
    fastest: float = quantity("m/s", "Speed that the controller sees as 1", gt=0, default=1.0)

    def bind(self, matter: Matter) -> BoundObserver:
        """Bind this observer to a scene's particles."""
        return MyReading(self, matter)


class MyReading(BoundObserver):
    """The observer over the particles of one scene."""

    def __init__(self, spec: MyObserver, matter: Matter) -> None:
        # one row of weights for each sum over particles that is needed: here one mean
        self.rows = means([matter.members(spec.body, spec.group)], matter.n_particles)
        self.size = matter.dim
        self.low, self.high = np.full(self.size, -spec.fastest), np.full(self.size, spec.fastest)

    def observe(self, moment: Moment) -> tuple[Array, Array]:
        """Return the values (size,) and what is remembered until the next control step (nothing)."""
        return moment.v[0], np.zeros(0)

    def observe_vjp(self, moment: Moment, z_bar: Array, memory_next_bar: Array) -> MomentBar:
        """Return the cotangent of the moment from that of the values."""
        return MomentBar(v=z_bar[None])
