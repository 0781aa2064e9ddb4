"""Ogden's law: W = sum_k mu_k / alpha_k (l_1^alpha_k + l_2^alpha_k + l_3^alpha_k - 3).

(Ogden, Proc. R. Soc. Lond. A 326, 1972.) l_i = J^(-1/3) sqrt(b_i) are the isochoric stretches, b_i the eigenvalues of
B = F F^T. On the principal axes

    tau_i = sum_k mu_k (l_i^alpha_k - mean_j l_j^alpha_k).

Adjoint of an isotropic tensor function (Daleckii and Krein): off the diagonal, the cotangent on the principal axes is
multiplied by (tau_i - tau_j) / (b_i - b_j). With x = log(l_i / l_j) the quotient is

    sum_k mu_k alpha_k / 2 (l_i l_j)^(alpha_k / 2) / sqrt(b_i b_j) sinhc(alpha_k x / 2) / sinhc(x)

with sinhc(y) = sinh(y) / y, which has no difference of nearly equal numbers, and is a series where x is small.

In 2D the third principal axis is across the plane, and b_3 = 1.
"""

from __future__ import annotations

from functools import reduce
from typing import Any, ClassVar, NamedTuple

from numba.extending import overload, register_jitable
from pydantic import model_validator

from cqrun.explain import complaint, finding
from cqrun.materials.rubber import Rubber, Shape, register_rubber
from cqrun.materials.term import add_rows
from cqrun.numerics.compile import written
from cqrun.numerics.eigen import eigen
from cqrun.numerics.elementary import exponential, logarithm
from cqrun.numerics.lanes import below, select, sqrt
from cqrun.numerics.tensor import by_dimension, cofactor, det, mul, mul_at, mul_bt, scale, symmetric
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin

CLOSE = 0.1
"""Logarithms of principal stretches that differ by less take the series of the quotient."""

SAME = 1e-16
"""Square of a difference that is small enough for the series with any exponent."""


class OgdenKernel(NamedTuple):
    """Kernels' view: rows mu_1 [Pa], alpha_1, ... of up to three terms, and K [Pa] or nu."""

    theta: Array
    rows: tuple[int, ...]
    by_ratio: int


@plugin("elastic", "ogden")
class Ogden(Rubber):
    """Ogden's law, W = sum of mu_k / alpha_k (l_1^alpha_k + l_2^alpha_k + l_3^alpha_k - 3), and U(J) as the others.

    One to three terms, each with mu_k alpha_k > 0. The shear modulus at rest is the sum of mu_k alpha_k / 2. Programs
    that write 2 mu / alpha^2 in place of mu / alpha (Abaqus) have mu = mu_k alpha_k / 2.
    """

    kernel: ClassVar[Any] = OgdenKernel
    mu_1: float = quantity("Pa", "Modulus of the first term", differentiable=True)
    alpha_1: float = quantity("1", "Exponent of the first term, not 0", differentiable=True)
    mu_2: float | None = quantity("Pa", "Modulus of the second term", differentiable=True, default=None)
    alpha_2: float | None = quantity("1", "Exponent of the second term", differentiable=True, default=None)
    mu_3: float | None = quantity("Pa", "Modulus of the third term", differentiable=True, default=None)
    alpha_3: float | None = quantity("1", "Exponent of the third term", differentiable=True, default=None)

    @property
    def own(self) -> tuple[str, ...]:  # type: ignore[override]
        """The parameters of the terms that are given."""
        terms = [k for k in (1, 2, 3) if getattr(self, f"mu_{k}") is not None]
        return tuple(f"{name}_{k}" for k in terms for name in ("mu", "alpha"))

    @model_validator(mode="after")
    def _whole_terms(self) -> Ogden:
        findings = []
        for k in (1, 2, 3):
            mu, alpha = getattr(self, f"mu_{k}"), getattr(self, f"alpha_{k}")
            if (mu is None) != (alpha is None):
                findings.append(
                    finding(f"a term needs both mu_{k} and alpha_{k}", (f"{'mu' if mu is None else 'alpha'}_{k}",))
                )
            elif mu is not None and not mu * alpha > 0:
                findings.append(finding(f"mu_{k} alpha_{k} must be above 0, is {mu * alpha:g}", (f"mu_{k}",)))
        if self.mu_3 is not None and self.mu_2 is None:
            findings.append(finding("is given, but no second term: call it mu_2 and alpha_2", ("mu_3",)))
        if findings:
            raise complaint("Ogden", findings)
        return self


# --- over all terms ---------------------------------------------------------------------------------------------------


def over_terms(function: Any, name: str, arguments: str, *, joined: bool = False) -> Any:
    """Return a function of theta and further arguments: function(mu, alpha, ...) of all terms, added up or joined.

    Args:
        function: returns a tuple.
        joined: whether the tuples follow one another; they are added up if not.
    """

    def every(theta: Any, *given: Any) -> Any:
        parts = [function(theta[2 * k], theta[2 * k + 1], *given) for k in range(len(theta) // 2)]
        return reduce((lambda a, b: a + b) if joined else add_rows, parts)

    def compiled(theta: Any) -> Any:
        parts = [f"one(theta[{2 * k}], theta[{2 * k + 1}], {arguments})" for k in range(len(theta) // 2)]
        source = reduce(lambda a, b: f"{a} + {b}" if joined else f"add_rows({a}, {b})", parts)
        return written(f"lambda theta, {arguments}: {source}", {"one": one, "add_rows": add_rows})

    one = register_jitable(function)
    scope: dict[str, Any] = {"every": every, "compiled": compiled}
    exec(f"def {name}(theta, {arguments}):\n    return every(theta, {arguments})", scope)
    exec(f"def choose(theta, {arguments}):\n    return compiled(theta)", scope)
    overload(scope[name])(scope["choose"])
    return scope[name]


@register_jitable
def powers(alpha: Any, e: Any) -> Any:
    """Return l_i^alpha of the logarithms e (3) of the isochoric stretches."""
    return exponential(alpha * e[0]), exponential(alpha * e[1]), exponential(alpha * e[2])


def term_tensions(mu: Any, alpha: Any, e: Any) -> Any:
    """Return tau_i (3)."""
    p = powers(alpha, e)
    mean = (p[0] + p[1] + p[2]) * (1.0 / 3.0)
    return mu * (p[0] - mean), mu * (p[1] - mean), mu * (p[2] - mean)


def term_slopes(mu: Any, alpha: Any, e: Any, q: Any) -> Any:
    """Return the cotangents of e (3) from those of tau_i (3), q."""
    p, mean = powers(alpha, e), (q[0] + q[1] + q[2]) * (1.0 / 3.0)
    k = mu * alpha
    return k * p[0] * (q[0] - mean), k * p[1] * (q[1] - mean), k * p[2] * (q[2] - mean)


def term_rows(mu: Any, alpha: Any, e: Any, q: Any) -> Any:
    """Return the cotangents of mu and alpha from those of tau_i (3), q."""
    p, mean = powers(alpha, e), (q[0] + q[1] + q[2]) * (1.0 / 3.0)
    a, b, c = p[0] * (q[0] - mean), p[1] * (q[1] - mean), p[2] * (q[2] - mean)
    return a + b + c, mu * (a * e[0] + b * e[1] + c * e[2])


def term_quotients(mu: Any, alpha: Any, e: Any, pairs: Any) -> Any:
    """Return (tau_i - tau_j) / (b_i - b_j) of the pairs 12, 13, 23."""
    p = powers(alpha, e)
    return (
        quotient(mu, alpha, p[0], p[1], pairs[0]),
        quotient(mu, alpha, p[0], p[2], pairs[1]),
        quotient(mu, alpha, p[1], p[2], pairs[2]),
    )


@register_jitable
def quotient(mu: Any, alpha: Any, p: Any, r: Any, pair: Any) -> Any:
    """Return mu (p - r) / (b - d) for l_i^alpha = p and l_j^alpha = r, and what `pair_of` returns."""
    x, apart, together = pair
    y = 0.5 * alpha * x
    close = below(x * x, x * 0.0 + CLOSE * CLOSE) & below(y * y, y * 0.0 + 1.0)
    return mu * select(close, 0.5 * alpha * sqrt(p * r) * sinhc(y) * together, (p - r) * apart)


@register_jitable
def pair_of(x: Any, b: Any, d: Any) -> Any:
    """Return x = log(l_i / l_j), 1 / (b - d) and 1 / (sqrt(b d) sinhc(x)): what all terms have in common.

    The first quotient is not used, and is 1, where b - d may be zero.
    """
    one = x * 0.0 + 1.0
    return x, 1.0 / select(below(x * x, SAME * one), one, b - d), 1.0 / (sqrt(b * d) * sinhc(x))


@register_jitable
def sinhc(y: Any) -> Any:
    """Return sinh(y) / y for |y| <= 1, by its series."""
    s = y * y
    inner_part = 1.0 + s * (1.0 / 210.0) * (1.0 + s * (1.0 / 272.0))
    inner_part = 1.0 + s * (1.0 / 110.0) * (1.0 + s * (1.0 / 156.0) * inner_part)
    return 1.0 + s * (1.0 / 6.0) * (
        1.0 + s * (1.0 / 20.0) * (1.0 + s * (1.0 / 42.0) * (1.0 + s * (1.0 / 72.0) * inner_part))
    )


tensions = over_terms(term_tensions, "tensions", "e")
slopes = over_terms(term_slopes, "slopes", "e, q")
rows_bar = over_terms(term_rows, "rows_bar", "e, q", joined=True)
quotients = over_terms(term_quotients, "quotients", "e, pairs")


# --- the law ----------------------------------------------------------------------------------------------------------


def _three_2d(a: Any) -> Any:
    return a[0], a[1], a[0] * 0.0


def _three_3d(a: Any) -> Any:
    return a


def of_three(a: Any) -> Any:
    """Return three principal values: in 2D the third one is 0."""
    return _three_2d(a) if len(a) == 2 else _three_3d(a)


@overload(of_three)
def _of_three(a: Any) -> Any:
    return _three_2d if len(a) == 2 else _three_3d


@register_jitable
def principal(F: Any) -> Any:
    """Return the eigenvalues b (3) of B, their vectors Q, and the logarithms e (3) of the isochoric stretches."""
    values, Q = eigen(mul_bt(F, F))
    b = of_three(values)
    b = b if len(F) == 9 else (b[0], b[1], b[2] + 1.0)
    L = logarithm(b[0]), logarithm(b[1]), logarithm(b[2])
    mean = (L[0] + L[1] + L[2]) * (1.0 / 6.0)
    return b, Q, (0.5 * L[0] - mean, 0.5 * L[1] - mean, 0.5 * L[2] - mean)


def _diagonal_2d(a: Any) -> Any:
    """Return the diagonal of a matrix (3): in 2D the third entry is 0."""
    return a[0], a[3], a[0] * 0.0


def _diagonal_3d(a: Any) -> Any:
    """Return the diagonal of a matrix (3): in 2D the third entry is 0."""
    return a[0], a[4], a[8]


def _with_diagonal_2d(t: Any, off: Any, A: Any) -> Any:
    return t[0], off[0] * A[1], off[0] * A[2], t[1]


def _with_diagonal_3d(t: Any, off: Any, A: Any) -> Any:
    return t[0], off[0] * A[1], off[1] * A[2], off[0] * A[3], t[1], off[2] * A[5], off[1] * A[6], off[2] * A[7], t[2]


diagonal = by_dimension(_diagonal_2d, _diagonal_3d)


def with_diagonal(t: Any, off: Any, A: Any) -> Any:
    """Return the matrix with a diagonal t, and off the diagonal the entries of A times `off` of their pair."""
    return _with_diagonal_2d(t, off, A) if len(A) == 4 else _with_diagonal_3d(t, off, A)


@overload(with_diagonal)
def _with_diagonal(t: Any, off: Any, A: Any) -> Any:
    return _with_diagonal_2d if len(A) == 4 else _with_diagonal_3d


@register_jitable
def turned(Q: Any, A: Any) -> Any:
    """Return Q A Q^T."""
    return mul_bt(mul(Q, A), Q)


def stress(term: Any, theta: Any, F: Any) -> Any:
    """Return tau_W."""
    _, Q, e = principal(F)
    zero = e[0] * 0.0
    return turned(Q, with_diagonal(tensions(theta, e), (zero, zero, zero), F))


def both(term: Any, theta: Any, F: Any, tau_bar: Any) -> Any:
    """Return (tau_W, theta_bar, F_bar)."""
    b, Q, e = principal(F)
    bar = mul_at(Q, mul(symmetric(tau_bar), Q))
    q = diagonal(bar)
    e_bar = slopes(theta, e, q)
    mean = (e_bar[0] + e_bar[1] + e_bar[2]) * (1.0 / 6.0)
    b_bar = (0.5 * e_bar[0] - mean) / b[0], (0.5 * e_bar[1] - mean) / b[1], (0.5 * e_bar[2] - mean) / b[2]
    pairs = pair_of(e[0] - e[1], b[0], b[1]), pair_of(e[0] - e[2], b[0], b[2]), pair_of(e[1] - e[2], b[1], b[2])
    B_bar = turned(Q, with_diagonal(b_bar, quotients(theta, e, pairs), bar))
    zero = e[0] * 0.0
    tau = turned(Q, with_diagonal(tensions(theta, e), (zero, zero, zero), F))
    return tau, rows_bar(theta, e, q), scale(mul(B_bar, F), 2.0)


def term_energy(mu: Any, alpha: Any, e: Any) -> Any:
    """Return W of a term."""
    p = powers(alpha, e)
    return (mu / alpha * (p[0] + p[1] + p[2] - 3.0),)


def term_energy_rows(mu: Any, alpha: Any, e: Any, W_bar: Any) -> Any:
    """Return the cotangents of mu and alpha."""
    p = powers(alpha, e)
    more, along = p[0] + p[1] + p[2] - 3.0, p[0] * e[0] + p[1] * e[1] + p[2] * e[2]
    return more / alpha * W_bar, mu / alpha * (along - more / alpha) * W_bar


energies = over_terms(term_energy, "energies", "e")
energy_rows = over_terms(term_energy_rows, "energy_rows", "e, W_bar", joined=True)


def energy(term: Any, theta: Any, F: Any) -> Any:
    """Return W."""
    return energies(theta, principal(F)[2])[0]


def energy_vjp(term: Any, theta: Any, F: Any, W_bar: Any) -> Any:
    """Return (theta_bar, F_bar), F_bar = W_bar tau_W F^-T."""
    e = principal(F)[2]
    return energy_rows(theta, e, W_bar), scale(mul(stress(term, theta, F), cofactor(F)), W_bar / det(F))


def term_shear(mu: Any, alpha: Any, unit: Any) -> Any:
    """Return the shear modulus of a term, times 1."""
    return (0.5 * mu * alpha * unit,)


def term_shear_rows(mu: Any, alpha: Any, mu_bar: Any) -> Any:
    """Return the cotangents of mu and alpha."""
    return 0.5 * alpha * mu_bar, 0.5 * mu * mu_bar


shears = over_terms(term_shear, "shears", "unit")
shear_rows = over_terms(term_shear_rows, "shear_rows", "mu_bar", joined=True)


def shear(theta: Any) -> Any:
    """Return mu at rest."""
    return shears(theta, 1.0)[0]


def shear_vjp(theta: Any, mu_bar: Any) -> Any:
    """Return theta_bar."""
    return shear_rows(theta, mu_bar)


register_rubber(OgdenKernel, Shape(stress, both, energy, energy_vjp, shear, shear_vjp))
