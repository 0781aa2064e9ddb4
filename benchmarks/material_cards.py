"""Make the cards in cqrun/materials/cards/ from tests, with the work of `cqrun material`.

    python benchmarks/material_cards.py DATA

DATA has `tensile/` (six silicones of the Soft Robotics Materials Database) and `rubber/` (Meunier 2008, Treloar 1944).
The tensile tests are used up to a strain of 3, because soft robots rarely strain more. Every number of a card is
computed here, and the script overwrites all cards.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from cqrun.scene.document import write
from cqrun.scene.fragments import CARDS
from cqrun.store.atomic import write_text
from cqrun.tensile.cleaning import clean
from cqrun.tensile.curve import Given
from cqrun.tensile.laws import all_laws
from cqrun.tensile.material import Material, characterise, shown
from cqrun.tensile.outputs import fragment
from cqrun.tensile.reading import read_curves

DATABASE = (
    "Soft Robotics Materials Database (Marechal et al., Soft Robotics 2020; "
    "github.com/LucMarechal/Soft-Robotics-Materials-Database)"
)
DATABASE_LICENCE = "the data: Open Database License 1.0; this card has numbers that were computed from them"
COLLECTED = "as collected in github.com/Chongran-Zhao/Calibration-Hyperelasticity (MIT)"
POINTS_LICENCE = "points of a published figure; this card has numbers that were computed from them"

RATIO = 0.49
LARGEST = 3.0
"""Strain up to which tensile tests are used."""

SHORTER = (0.5, 1.0, 2.0)
"""Strains of shorter fits, which show how much a modulus depends on the range."""

TENSILE = {
    "ecoflex_00_30": ("Ecoflex 00-30.csv", "Ecoflex 00-30 (Smooth-On)"),
    "dragon_skin_10_medium": ("Dragon Skin 10 MEDIUM.csv", "Dragon Skin 10 Medium (Smooth-On)"),
    "dragon_skin_30": ("Dragon Skin 30.csv", "Dragon Skin 30 (Smooth-On)"),
    "mold_star_16_fast": ("Mold Star 16 FAST.csv", "Mold Star 16 Fast (Smooth-On)"),
    "rtv615": ("RTV615.csv", "RTV615 (Momentive)"),
    "soloplast_150318": ("SOLOPLAST 150318.csv", "Silicone 150318 (Soloplast-Vosschemie)"),
}
RUBBER = {
    "rtv_3428": (
        "meunier_2008.csv", "RTV 3428, unfilled silicone",
        f"Meunier et al., Polymer Testing 2008; {COLLECTED}",
    ),
    "natural_rubber_treloar": (
        "treloar_1944.csv", "Vulcanised natural rubber of Treloar",
        f"Treloar, Trans. Faraday Soc. 1944; {COLLECTED}",
    ),
}  # fmt: skip


def material_of(path: Path, largest: float | None) -> Material:
    """Return the material of a file up to a strain."""
    given = Given(span=None if largest is None else (float("-inf"), largest))
    return characterise([clean(curve, given) for curve in read_curves(path, given)], all_laws(), RATIO)


def young(material: Material) -> float:
    """Return Young's modulus at rest of the chosen law [Pa]."""
    best = material.chosen
    return best.law.moduli(best.fit.values, RATIO).young


def card(path: Path, title: str, source: str, licence: str, largest: float | None) -> dict[str, Any]:
    """Return the content of a card."""
    material = material_of(path, largest)
    best = material.chosen
    modulus, shear = young(material), best.certainty.shear
    ratio = 2.0 * (1.0 + RATIO)
    stretch = max(float(curve.stretch.max()) for curve in material.curves)
    modes = ", ".join(dict.fromkeys(curve.mode for curve in material.curves))
    spread: dict[str, Any] = {
        name: None if interval is None else [float(f"{x:.4g}") for x in interval]
        for name, interval in best.certainty.intervals.items()
    }
    spread["E at rest"] = None if shear is None else [float(f"{x * ratio:.4g}") for x in shear]
    reached = max(curve.stretch.max() for curve in material.curves) - 1.0
    others = {
        f"strain up to {strain:g}": shown(young(material_of(path, strain))) for strain in SHORTER if strain < reached
    }
    option = "" if largest is None else f" --range :{largest:g}"
    return {
        "title": title,
        "summary": f"{best.law.name}, E {shown(modulus)} at rest, {modes} to a stretch of {stretch:.3g}",
        "source": f"{source}; file {path.name}",
        "licence": licence,
        "made_by": f'cqrun material "{path.name}"{option} --poissons-ratio {RATIO}',
        "error": f"{best.fit.rms:.2%} of the largest stress (root mean square)",
        "stable_to": float(f"{best.stable_to:.3g}"),
        "spread": spread,
        "E_at_rest_by_range": others | {"this card": shown(modulus)},
        "trust": [*material.warnings, *material.trust, "Poisson's ratio is not measured"],
        "material": fragment(replace(material, warnings=())),
    }


def main() -> None:
    """Write all cards."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    data = parser.parse_args().data
    CARDS.mkdir(exist_ok=True)
    for name, (file, title) in TENSILE.items():
        content = card(data / "tensile" / file, title, DATABASE, DATABASE_LICENCE, LARGEST)
        write_text(CARDS / f"{name}.yaml", write(content))
        print(f"{name}: {content['summary']}")
    for name, (file, title, source) in RUBBER.items():
        content = card(data / "rubber" / file, title, source, POINTS_LICENCE, None)
        write_text(CARDS / f"{name}.yaml", write(content))
        print(f"{name}: {content['summary']}")


if __name__ == "__main__":
    main()
