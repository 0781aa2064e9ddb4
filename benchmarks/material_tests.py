"""Compare the fits of `cqrun material` with an independent search, and modes of rubbers with predictions from others.

    python benchmarks/material_tests.py DATA [--out benchmarks/measured/material_tests.csv]

DATA has `tensile/` (six silicones) and `rubber/` (Meunier 2008, Treloar 1944).

The independent optimum does not use the package's laws or its search. Stresses are the textbook's, by invariants or
stretches. In moduli they are linear, so linear least squares gives their optimum. Numbers that are no moduli are found
by differential evolution (Ogden, with mu_k alpha_k > 0), or by trying 4,000 values and refining the best (Gent, Arruda
and Boyce).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from scipy.optimize import differential_evolution, minimize_scalar, nnls

from cqrun.materials.curves import MODES
from cqrun.store.atomic import write_table
from cqrun.tensile.choice import CLOSE
from cqrun.tensile.cleaning import clean
from cqrun.tensile.curve import Curve, Given
from cqrun.tensile.fits import Fit, errors_by_mode, fit_law, residuals_of
from cqrun.tensile.laws import Law, all_laws
from cqrun.tensile.reading import modes_in, read_curves

Array = np.ndarray
HEAD = ("file", "law", "fitted_to", "what", "rms_percent", "independent_percent")
SERIES = (1 / 2, 1 / 20, 11 / 1050, 19 / 7000, 519 / 673750)
TRIED = 4000


def stretches(curve: Curve) -> tuple[Array, Array, Array]:
    """Return the three principal stretches of a curve."""
    first = curve.stretch
    second = first ** MODES[curve.mode]
    return first, second, 1.0 / (first * second)


def by_invariants(curve: Curve, of_first: Array, of_second: Array | float = 0.0) -> Array:
    """Return P = (tau_1 - tau_3) / l_1 with tau_i = 2 (W1 l_i^2 - W2 l_i^-2) (Rivlin)."""
    l, _, n = stretches(curve)  # noqa: E741 (as in the formulas)
    return np.asarray(2.0 * (of_first * (l**2 - n**2) - of_second * (l**-2 - n**-2)) / l)


def first_invariant(curve: Curve) -> Array:
    """Return I1."""
    return np.asarray(sum(x**2 for x in stretches(curve)))


def columns(law: str, curve: Curve, free: Sequence[float]) -> list[Array]:
    """Return the nominal stress (n,) of unit moduli, one column for each."""
    l, _, n = stretches(curve)  # noqa: E741
    one, x = np.ones_like(l), first_invariant(curve) - 3.0
    if law == "neo_hookean":
        return [by_invariants(curve, one / 6.0)]  # E = 3 mu
    if law == "fixed_corotated":
        return [2.0 / 3.0 * (l**2 - l - n**2 + n) / l]
    if law == "mooney_rivlin":
        return [by_invariants(curve, one), by_invariants(curve, 0.0 * one, one)]
    if law == "yeoh":
        return [by_invariants(curve, k * x ** (k - 1)) for k in (1, 2, 3)]
    if law == "gent":
        return [by_invariants(curve, 0.5 * free[0] / (free[0] - x))]
    if law == "arruda_boyce":
        sums = sum(k * c * (x + 3.0) ** (k - 1) / free[0] ** (2 * k - 2) for k, c in enumerate(SERIES, 1))
        return [by_invariants(curve, np.asarray(sums))]
    return [(l**alpha - n**alpha) / l for alpha in free]


def best_rms(law: str, curves: Sequence[Curve], free: Sequence[float]) -> float:
    """Return the error of a law with some numbers that are no moduli, and the moduli that are best with them."""
    parts = [np.array(columns(law, curve, free)) / curve.largest_stress for curve in curves]
    matrix, measured = np.concatenate(parts, axis=1).T, np.concatenate([c.stress / c.largest_stress for c in curves])
    sizes = np.linalg.norm(matrix, axis=0)
    if not np.isfinite(matrix).all() or not sizes.all():
        return 1e3
    if law == "ogden":  # mu_k alpha_k has to be positive
        matrix = matrix * np.sign(np.asarray(free))
        return float(nnls(matrix / sizes, measured)[1] / np.sqrt(len(measured)))
    moduli = np.linalg.lstsq(matrix / sizes, measured, rcond=1e-12)[0]
    return float(np.sqrt(np.mean((matrix / sizes @ moduli - measured) ** 2)))


def independent(law: Law, curves: Sequence[Curve]) -> float:
    """Return the error of the best parameters, found without the package's laws and search."""
    if law.name == "ogden":
        found = differential_evolution(
            lambda alphas: best_rms("ogden", curves, alphas), [(-15.0, 15.0)] * law.terms, seed=1, popsize=20,
            maxiter=300, tol=1e-10,
        )  # fmt: skip
        return float(found.fun)
    largest = max(float(first_invariant(curve).max()) for curve in curves) - 3.0
    tried: dict[str, Array] = {
        "gent": largest * (1.0 + np.geomspace(1e-4, 1e3, TRIED)),
        "arruda_boyce": np.geomspace(1.001, 100.0, TRIED),
    }
    if law.name not in tried:
        return best_rms(law.name, curves, ())
    values = tried[law.name]
    errors = [best_rms(law.name, curves, (value,)) for value in values]
    k = int(np.argmin(errors))
    near = values[max(k - 1, 0)], values[min(k + 1, TRIED - 1)]
    refined = minimize_scalar(lambda x: best_rms(law.name, curves, (x,)), bounds=near, method="bounded")
    return float(min(refined.fun, errors[k]))


def fitted(law: Law, curves: Sequence[Curve]) -> Fit:
    """Return the package's fit."""
    fit = fit_law(law, curves)
    assert fit is not None
    return fit


def tensile_rows(path: Path, laws: Sequence[Law]) -> Iterator[Sequence[object]]:
    """Yield a row for each law of a tensile test: on the cleaned curve, and on the file as it is."""
    raw = read_curves(path, Given())
    curves = [clean(curve, Given()) for curve in raw]
    for law in laws:
        fit = fitted(law, curves)
        as_it_is = float(np.sqrt(np.mean(residuals_of(law, fit.values, raw) ** 2)))
        for what, error, others in (("cleaned", fit.rms, curves), ("as it is", as_it_is, raw)):
            yield path.name, law.title, "uniaxial", what, percent(error), percent(independent(law, others))


def rubber_rows(path: Path, laws: Sequence[Law]) -> Iterator[Sequence[object]]:
    """Yield rows for a rubber: fitted to uniaxial tests alone and to all modes, with the error of each mode."""
    curves = [clean(curve, Given()) for curve in read_curves(path, Given())]
    alone = [curve for curve in curves if curve.mode == "uniaxial"]
    for own, name in ((alone, "uniaxial"), (curves, "all")):
        for law in laws:
            fit = fitted(law, own)
            by_mode = errors_by_mode(law, fit.values, curves)
            yield path.name, law.title, name, "all fitted", percent(fit.rms), percent(independent(law, own))
            for mode in modes_in(curves):
                yield path.name, law.title, name, mode, percent(by_mode[mode]), None


def percent(error: float) -> float:
    """Return an error in percent with four digits."""
    return float(f"{100.0 * error:.4g}")


def main() -> None:
    """Write the table, and print it with the largest distance from the independent optimum."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "measured" / "material_tests.csv")
    parsed = parser.parse_args()
    laws, rows = all_laws(), list[Sequence[object]]()
    rows_of: Callable[[Path, Sequence[Law]], Iterator[Sequence[object]]]
    for folder, rows_of in (("tensile", tensile_rows), ("rubber", rubber_rows)):
        for path in sorted((parsed.data / folder).glob("*.csv")):
            for row in rows_of(path, laws):
                rows.append(row)
                print(*("" if cell is None else cell for cell in row), sep="\t", flush=True)
    write_table(parsed.out, [HEAD, *rows])
    apart = [row[4] - row[5] for row in rows if isinstance(row[4], float) and isinstance(row[5], float)]
    print(f"largest distance from the independent optimum: {max(apart):.3g} % of the largest stress")
    print(f"(a further term of a law has to lower the error by {CLOSE:.1%})")


if __name__ == "__main__":
    main()
