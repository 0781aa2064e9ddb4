"""The part of a material's energy that depends on the change of volume alone, U(J): the sum over its terms.

With averaged volumes (engine/reference/volume.py) it acts at the corners of cells, in place of the particles.
"""

from __future__ import annotations

from typing import Any

from numba.extending import overload, register_jitable

from cqrun.materials.term import accumulate_rows, load_rows, volume_slope, volume_slope_vjp


def total_slope(terms: Any, i: int, J: Any) -> Any:
    """Return the sum of U' of all terms for the lane at i."""
    slope = volume_slope(terms[0], load_rows(terms[0].theta, terms[0].rows, i), J)
    return slope + total_slope(terms[1:], i, J) if len(terms) > 1 else slope


@overload(total_slope)
def _total_slope(terms, i, J):
    def one(terms, i, J):
        return volume_slope(terms[0], load_rows(terms[0].theta, terms[0].rows, i), J)

    def several(terms, i, J):
        return one_of(terms, i, J) + total_slope(terms[1:], i, J)

    one_of = register_jitable(one)
    return several if len(terms) > 1 else one


def total_slope_vjp(terms: Any, terms_bar: Any, i: int, J: Any, slope_bar: Any) -> Any:
    """Return J_bar; add to the cotangents of the parameters in terms_bar."""
    theta_bar, J_bar = volume_slope_vjp(terms[0], load_rows(terms[0].theta, terms[0].rows, i), J, slope_bar)
    accumulate_rows(terms_bar[0].theta, terms[0].rows, i, theta_bar)
    return J_bar + total_slope_vjp(terms[1:], terms_bar[1:], i, J, slope_bar) if len(terms) > 1 else J_bar


@overload(total_slope_vjp)
def _total_slope_vjp(terms, terms_bar, i, J, slope_bar):
    def one(terms, terms_bar, i, J, slope_bar):
        theta_bar, J_bar = volume_slope_vjp(terms[0], load_rows(terms[0].theta, terms[0].rows, i), J, slope_bar)
        accumulate_rows(terms_bar[0].theta, terms[0].rows, i, theta_bar)
        return J_bar

    def several(terms, terms_bar, i, J, slope_bar):
        return one_of(terms, terms_bar, i, J, slope_bar) + total_slope_vjp(terms[1:], terms_bar[1:], i, J, slope_bar)

    one_of = register_jitable(one)
    return several if len(terms) > 1 else one


def total_curvature(terms: Any, i: int, J: Any) -> Any:
    """Return the sum of U'' of all terms for the lane at i."""
    curvature = volume_slope_vjp(terms[0], load_rows(terms[0].theta, terms[0].rows, i), J, J * 0.0 + 1.0)[1]
    return curvature + total_curvature(terms[1:], i, J) if len(terms) > 1 else curvature


@overload(total_curvature)
def _total_curvature(terms, i, J):
    def one(terms, i, J):
        return volume_slope_vjp(terms[0], load_rows(terms[0].theta, terms[0].rows, i), J, J * 0.0 + 1.0)[1]

    def several(terms, i, J):
        return one_of(terms, i, J) + total_curvature(terms[1:], i, J)

    one_of = register_jitable(one)
    return several if len(terms) > 1 else one
