"""The lattices on which particles were sampled: a part of the model, from which gaps in a body are known."""

from __future__ import annotations

from typing import NamedTuple

from cqrun.plugin.contract import Array


class Lattice(NamedTuple):
    """Where neighbours are, from which gaps in a body are known.

    `x` (N, D) are the positions of all particles on their lattices [m], whatever shape they take later. `spacing` (B,)
    is the distance between neighbours in each body [m], 0 for those that are not on one lattice.
    """

    x: Array
    spacing: Array
