"""Pull tests and relaxation tests of known laws, as machines write them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from cqrun.materials.rubber import Rubber, Shape, register_rubber
from cqrun.plugin.contract import Array, quantity
from cqrun.tensile.curve import Curve
from cqrun.tensile.laws import Law, laws_of

DATA = Path(__file__).parents[2] / "shared" / "data"
"""Real tests, where they are."""


def curve(
    law: Law, values: Sequence[float], stretch: Array, mode: Any = "uniaxial", noise: float = 0.0, seed: int = 5
) -> Curve:
    """Return the curve of a law, with noise relative to its largest stress."""
    stress = law.stress(np.array(values), mode, stretch)
    stress = stress + noise * np.abs(stress).max() * np.random.default_rng(seed).standard_normal(len(stress))
    return Curve(f"{mode}.csv", mode, stretch, stress, np.arange(2, len(stretch) + 2))


def silicone(strain: Array, modulus: float = 3e5) -> Array:
    """Return the nominal stress [Pa] of a Neo-Hookean silicone in uniaxial tension or compression."""
    stretch = 1.0 + strain
    return np.asarray(modulus / 3.0 * (stretch - stretch**-2))


def write(
    folder: Path, columns: dict[str, Array | Sequence[Any]], *, name: str = "pull.csv", header: Sequence[str] = (),
    separator: str = ";", comma: bool = False, encoding: str = "utf-8", digits: int = 9,
) -> Path:  # fmt: skip
    """Write columns with their headers to a file, and return its path."""
    lines = [*header, separator.join(columns)]
    for row in zip(*columns.values(), strict=True):
        cells = [cell if isinstance(cell, str) else f"{cell:.{digits}g}" for cell in row]
        lines.append(separator.join(cell.replace(".", ",") if comma else cell for cell in cells))
    path = folder / name
    path.write_bytes(("\n".join(lines) + "\n").encode(encoding))
    return path


def pull(folder: Path, strain: Array | None = None, stress: Array | None = None, **options: Any) -> Path:
    """Write a tensile test with everything that is needed in its header."""
    strain = np.linspace(0.0, 2.0, 60) if strain is None else strain
    stress = silicone(strain) if stress is None else stress
    columns = {"Engineering strain (mm/mm)": strain, "Engineering stress (MPa)": stress * 1e-6}
    return write(folder, columns, header=["Standard;ASTM D412"], **options)


class TermsKernel(NamedTuple):
    """Rows mu_1, alpha_1, ..., and nu."""

    theta: Array
    rows: tuple[int, ...]
    by_ratio: int


class Terms(Rubber):
    """A law of powers of the stretches with one or two terms, whose fields are numbered."""

    name: ClassVar[str] = "powers"
    kernel: ClassVar[Any] = TermsKernel
    mu_1: float = quantity("Pa", "First modulus", differentiable=True)
    alpha_1: float = quantity("1", "First power", differentiable=True)
    mu_2: float | None = quantity("Pa", "Second modulus", differentiable=True, default=None)
    alpha_2: float | None = quantity("1", "Second power", differentiable=True, default=None)

    @property
    def own(self) -> tuple[str, ...]:  # type: ignore[override]
        """The fields that are given."""
        return tuple(n for n in ("mu_1", "alpha_1", "mu_2", "alpha_2") if getattr(self, n) is not None)


def _stress(term: Any, theta: Any, F: Any) -> Any:
    """Return tau of a deformation along the axes."""
    size, zero = (F[0] * F[4] * F[8]) ** (-1 / 3), 0.0 * F[0]
    total = [zero, zero, zero]
    for k in range(0, len(theta) - 1, 2):
        powers = [(l * size) ** theta[k + 1] for l in (F[0], F[4], F[8])]  # noqa: E741
        total = [t + theta[k] * (p - sum(powers) / 3) for t, p in zip(total, powers, strict=True)]
    return (total[0], zero, zero, zero, total[1], zero, zero, zero, total[2])


def _shear(theta: Any) -> Any:
    return sum(theta[k] * theta[k + 1] for k in range(0, len(theta) - 1, 2)) / 2


def _unused(*values: Any) -> Any:
    raise NotImplementedError


register_rubber(TermsKernel, Shape(_stress, _unused, _unused, _unused, _shear, _unused))


def powers() -> list[Law]:
    """Return the law of powers with one term, and with two."""
    return list(laws_of(Terms))
