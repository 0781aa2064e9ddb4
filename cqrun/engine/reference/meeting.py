"""The arguments of the kernels of contact between bodies: facets, and which of them are near a point."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cqrun.engine.model import Model
from cqrun.engine.reference.contact import Surface, growth_of
from cqrun.engine.reference.movers import Movers, SurfaceBars, make_movers, zero_bars
from cqrun.numerics.compile import own_symbols
from cqrun.plugin.contract import Array

REACH = 0.75
"""Distance within which facets near a point are found [cells]. They are found again when a point and a facet may have
moved by half of it towards each other, so all facets within the other half are known: contact is never deeper."""

MOST = {2: 16, 3: 48}
"""Facets that are kept near a point, by dimension: the nearest ones. A plane has about half as many within reach."""


class Facets(NamedTuple):
    """The facets of all bodies. Moduli are those of a penalty and of a dashpot, per area."""

    corner: Array  # (T, D) points
    body: Array  # (S,) of each point
    begin: Array  # (B + 1,) where the points of a body begin
    area: Array  # (S,) of each point
    stiffness: Array  # (S,) of each point, and (T,) of each facet [Pa/m]
    facet_stiffness: Array
    impedance: Array  # (S,), (T,) [Pa s/m]
    facet_impedance: Array


class Hash(NamedTuple):
    """Facets by the cell of space with their centroid; a cell has a bucket, which other cells may share."""

    box: Array  # (B, 6) lowest and highest coordinates of each body
    cell: Array  # (T, 3) cell of each facet
    bucket: Array  # (T,) of each facet, -1 if it is far from all other bodies
    begin: Array  # (H + 1,) where the facets of a bucket begin in `order`; H is a power of 2
    order: Array  # (T,)
    size: Array  # (2,) edge of a cell, and largest distance of a vertex from its centroid [m]


class Pairs(NamedTuple):
    """Points near facets of other bodies, found again when a node has moved too far, and their contacts."""

    points: Array  # (S,) the first count[0] have facets near them, in increasing order
    active: Array  # (S,) the first count[1] are those, or vertices of such facets
    count: Array  # (2,)
    movers: Movers  # of the active points
    flag: Array  # (S,) whether a point is active
    facets: Array  # (S, MOST) facets near each point, and the squares of their distances
    square: Array
    many: Array  # (S,) how many
    mark: Array  # (K, 3) displacements of the nodes when they were found
    moved: Array  # (threads,) largest square of a node's way since
    margin: float  # of the distance of a point from a facet [m]
    reach: float  # way of nodes that may move a point and a facet together by half the margin [m]


class Meeting(NamedTuple):
    """All of contact between bodies, and arrays for the numbers of a point in a substep."""

    surface: Surface
    facets: Facets
    hash: Hash
    pairs: Pairs
    slid: Array  # (threads,) whether a force depended on a velocity or a spring, since it was last cleared
    friction: float
    dashpot: float
    springs: int  # 1 if each point has a tangential spring, else 0
    first: int  # number of its first spring
    touched: Array  # (S,) the facet in which a point is, or -1
    weights: Array  # (S, 3) of the facet's vertices
    x: Array  # (S, 3) positions, velocities and cotangents of forces of the points
    v: Array
    p: Array
    push: Array  # (S, 3) force on a point from the facet in which it is [N]
    force: Array  # (S, 3) sum of the forces on a point, also as a vertex [N]
    x_bars: Array  # (S, 4, 3) cotangents of a point and the three vertices of its facet
    v_bar: Array  # (S, 3) cotangent of a point's velocity relative to its facet
    u_sum: Array  # (S, 3) sums of the cotangents of each point's position and velocity
    v_sum: Array
    friction_bar: Array  # (S,) summed over substeps
    bars: SurfaceBars


for _class in (Facets, Hash, Pairs, Meeting):
    own_symbols(_class)


def make_meeting(model: Model, surface: Surface, coefficients: Array, n_threads: int) -> tuple[Meeting, ...]:
    """Return one entry, or none if bodies do not meet."""
    if model.meeting is None or model.surface is None:
        return ()
    own, (s, k) = model.surface, (len(surface.rest), len(surface.points.nodes))
    bodies = np.repeat(np.arange(len(model.layout.counts)), model.layout.counts)[own.particle]
    begin = np.searchsorted(bodies, np.arange(len(model.layout.counts) + 1)).astype(np.int64)
    corner = np.ascontiguousarray(own.facets, np.int64)
    stiffness, impedance = own.stiffness / own.area, own.impedance / own.area
    facets = Facets(
        corner, bodies.astype(np.int64), begin, np.array(own.area, np.float64), stiffness,
        stiffness[corner].mean(axis=1), impedance, impedance[corner].mean(axis=1),
    )  # fmt: skip
    t, most, margin = len(corner), MOST[model.dim], REACH * model.dx
    n_buckets = 1 << max(1, int(np.ceil(np.log2(2 * max(t, 1)))))
    lists = Hash(
        np.zeros((len(begin) - 1, 6)), np.zeros((t, 3), np.int64), np.full(t, -1), np.zeros(n_buckets + 1, np.int64),
        np.zeros(t, np.int64), np.zeros(2),
    )  # fmt: skip
    pairs = Pairs(
        np.zeros(s, np.int64), np.zeros(s, np.int64), np.zeros(2, np.int64), make_movers(surface.points),
        np.zeros(s, np.bool_), np.zeros((s, most), np.int64), np.zeros((s, most)), np.zeros(s, np.int64),
        np.full((k, 3), np.inf), np.zeros(n_threads), margin,
        margin / (4.0 * growth_of(surface.points)),
    )  # fmt: skip
    vectors = [np.zeros((s, 3)) for _ in range(6)]
    friction = float(coefficients[len(model.conditions)]) if model.meeting.rubs else 0.0
    return (
        Meeting(
            surface, facets, lists, pairs, np.zeros(n_threads, np.int64), friction,
            model.meeting.dashpot, int(model.meeting.rubs), model.n_springs - s, np.full(s, -1), *vectors,
            np.zeros((s, 4, 3)), np.zeros((s, 3)), np.zeros((s, 3)), np.zeros((s, 3)), np.zeros(s),
            zero_bars(surface.points, False),
        ),
    )  # fmt: skip
