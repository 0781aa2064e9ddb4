"""The result of one point of a path at rest, as a run keeps it."""

from __future__ import annotations

from cqrun.store.model_file import Part


class RestPoint(Part):
    """A point of a path of equilibria.

    Attributes:
        values: values of the path by key path.
        converged: whether an equilibrium was found.
        residual: net force divided by the loads.
        steps, products: steps of Newton's method, and products with the stiffness matrix.
        negative: whether the stiffness matrix has a negative eigenvalue.
        smallest: smallest eigenvalue of the preconditioned matrix; it vanishes at a limit point. None if unknown.
        halvings, reached: how often the way from the last point was halved, and the part of it that was covered.
        rounded: whether rounding, and not the tolerance, ended the search.
        jump, jump_at: largest displacement of a particle in a jump on that way [m], and where it is, or None.
    """

    values: dict[str, float]
    converged: bool
    residual: float
    steps: int
    products: int
    negative: bool
    smallest: float | None = None
    halvings: int
    reached: float
    rounded: bool = False
    jump: float | None = None
    jump_at: float | None = None
