"""Pull tests and relaxation tests of known laws, as machines write them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.plugin.contract import Array
from cqrun.tensile.curve import Curve
from cqrun.tensile.laws import Law, all_laws

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


def ogden() -> list[Law]:
    """Return Ogden's law with one, two and three terms."""
    return all_laws(["ogden"])
