"""`cqrun material`: from the files of a testing machine to a material for scenes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cqrun.errors import UsageError
from cqrun.running.reporter import Reporter, Silent
from cqrun.store.atomic import make_directory, write_json, write_text
from cqrun.tensile.cleaning import clean
from cqrun.tensile.curve import Curve, Given
from cqrun.tensile.laws import NU, all_laws
from cqrun.tensile.material import Material, characterise
from cqrun.tensile.outputs import JSON, YAML, about_long_term, as_json, fragment_text, table
from cqrun.tensile.reading import read_curves
from cqrun.tensile.relaxation import Relaxation, choose_relaxation, fit_relaxation


@dataclass(frozen=True)
class Tested:
    """What the tests have given: a material, relaxation or both, and where it is written."""

    material: Material | None
    relaxations: tuple[Relaxation, ...]
    folder: Path

    def lines(self) -> list[str]:
        """Return what a terminal shows."""
        lines = [] if self.material is None else list(table(self.material))
        for relaxation in self.relaxations:
            head, *known = relaxation.sentences()
            lines += ["", head, *(f"  {remark}" for remark in relaxation.curve.remarks), *known]
        if len(self.relaxations) > 1:
            lines.append(f"{YAML} has the branches of {self.relaxations[0].curve.source}")
        lines += about_long_term(self.material, self.relaxations)
        return lines


def make_material(
    files: Sequence[Path], given: Given | None = None, *, laws: Sequence[str] = (), ratio: float = NU,
    out: Path | None = None, reporter: Reporter | None = None,
) -> Tested:  # fmt: skip
    """Read tests, fit all laws, and write material.yaml and material.json.

    Args:
        files: of one material; several specimens, modes, or relaxation tests.
        given: what the files do not say.
        laws: names of those to fit; all if empty.
        ratio: Poisson's ratio in the scene.
        out: folder to write to; beside the first file, with its name, if not given.

    Raises:
        UsageError: an option is wrong, or nothing can be written. DataError: a file cannot be used as it is.
    """
    talk, given = reporter or Silent(), given or Given()
    if not -1.0 < ratio < 0.5:
        raise UsageError(f"--poissons-ratio {ratio:g}: must be between -1 and 0.5; 0.4999 is nearly incompressible")
    wanted = all_laws(laws)
    measured: list[Curve] = []
    for path in files:
        talk.phase(f"reading {path.name}")
        measured += read_curves(path, given)
    held, pulled = choose_relaxation(measured, given.relaxation)
    curves = [clean(curve, given) for curve in pulled]
    folder = out if out is not None else files[0].parent / files[0].stem
    make_directory(folder)
    relaxations = tuple(fit_relaxation(curve) for curve in held)
    material = characterise(curves, wanted, ratio, talk.phase) if curves else None
    write_text(folder / YAML, fragment_text(material, relaxations))
    write_json(folder / JSON, as_json(material, relaxations))
    return Tested(material, relaxations, folder)
