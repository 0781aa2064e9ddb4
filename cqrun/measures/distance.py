"""Distance between two places."""

from __future__ import annotations

from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from cqrun.explain import complaint, finding
from cqrun.measures.measure import BoundMeasure
from cqrun.measures.place import AtPlace, point_row
from cqrun.objectives.gaps import lengths, lengths_vjp
from cqrun.observers.matter import Matter
from cqrun.observers.rows import means, stacked
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array, vector
from cqrun.plugin.reference import BodyName, NamesGroup
from cqrun.plugin.reference import Position as InWorldPosition
from cqrun.plugin.registry import plugin


@plugin("measure", "distance")
class Distance(AtPlace):
    """Distance [m] of a place on a body from another place on a body, or from a fixed position in the world.

    A place is a point of the material, or the centroid (plain mean) of a body, group or region. Where the distance is
    0, its gradient is taken as 0.
    """

    position: InWorldPosition | None = vector("m", "Fixed position in the world", default=None)
    to: BodyName | None = Field(description="Body of the other place; the same body if absent", default=None)
    to_group: Annotated[str, NamesGroup(of="to")] | None = Field(description="Group of the other place", default=None)
    to_point: list[float] | None = vector("m", "Point of the material at rest, as the other place", default=None)

    @model_validator(mode="after")
    def _one_other_place(self) -> Self:
        others = [name for name in ("to_group", "to_point") if getattr(self, name) is not None]
        other = bool(others) or self.to is not None
        if (self.position is not None) == other or len(others) > 1:
            message = "needs exactly one other place: `position`, or `to` with a `to_group` or `to_point`"
            raise complaint("Distance", [finding(message, involves=("position", "to", *others))])
        return self

    def bind(self, matter: Matter) -> BoundMeasure:
        return PlaceGap(self, matter)


class PlaceGap(BoundMeasure):
    """Length of the gap between two places."""

    unit, meaning = "m", "distance"

    def __init__(self, spec: Distance, matter: Matter) -> None:
        rows, body = [spec.row(matter)], spec.to if spec.to is not None else spec.body
        self.position = None if spec.position is None else np.array(spec.position)
        if spec.to_point is not None:
            rows.append(point_row(matter, body, np.array(spec.to_point)))
        elif self.position is None:
            rows.append(means([matter.members(body, spec.to_group)], matter.n_particles))
        self.rows = stacked(rows, matter.n_particles)
        self.low, self.high = np.zeros(1), np.array([float(np.linalg.norm(matter.size))])

    def values(self, track: Track) -> Array:
        return lengths(self._gap(track), squared=False)[:, None]

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        gap_bar = lengths_vjp(self._gap(track), False, bar[:, 0])
        x_bar = np.zeros(track.x.shape)
        x_bar[:, 0] = gap_bar
        x_bar[:, 1:] = -gap_bar[:, None]
        return TrackBar(x=x_bar)

    def _gap(self, track: Track) -> Array:
        return np.asarray(track.x[:, 0] - (track.x[:, 1] if self.position is None else self.position))
