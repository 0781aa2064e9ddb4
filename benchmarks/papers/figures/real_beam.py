"""cqrun's own: a real silicone beam, fitted to motion capture, and predicted."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.papers.figure import NOT_PRINTED, Figure, Folders, Size, Table, Verdict, table_of
from benchmarks.papers.machinery.measurement import Measurement
from benchmarks.papers.machinery.process import ROOT
from benchmarks.papers.machinery.task import Task
from cqrun.figures.style import COLOURS, GREY, new_figure, titled
from cqrun.running.cluster import PROCESSES
from cqrun.store.atomic import write_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

MEASURED = ROOT / "benchmarks" / "measured" / "real_beam.json"
MODULUS = "bodies.beam.material.elastic.fixed_corotated.youngs_modulus"
LABELS = {
    "swing": "swing, both", "swing_bare": "swing, bare alone", "swing_fine": "swing, both, 3.75 mm",
    "rest": "rest, both", "rest_bare": "rest, bare alone", "rest_fine": "rest, both, 3.75 mm",
    "material": "swing and rest, with a history", "material_fine": "the same, 3.75 mm",
}  # fmt: skip
LIMITS = {"bare": 0.6, "loaded": 2.0}
PREDICTED = 2.5
"""Largest root mean square error of a predicted recording [mm]."""

RANGE = (230.0, 360.0)
"""Young's moduli that agree with published measurements of Dragon Skin 10 [kPa]."""


class Reading(Measurement):
    """What another command has measured, with its engine."""

    def engine(self, folder: Path) -> str:
        return str(json.loads(MEASURED.read_text())["engine"])

    def advance(self, folder: Path, seconds: float, jobs: int, share: float, on: str = PROCESSES) -> bool:
        return self.measure(folder, seconds)


class RealBeam(Figure):
    """Young's modulus and errors of eight fits; that with a history has the modulus after a long time."""

    id = "real_beam"
    title = "A real silicone beam, fitted and predicted"
    source = NOT_PRINTED
    paper = "not in the papers; recordings of the Soft Robotics Lab, ETH Zurich (MIT licence), srl-ethz/diffPD_sim2real"
    criteria = {
        size: "fitted: at most 0.6 mm bare and 2.0 mm loaded; predicted: at most 2.5 mm; E from 230 to 360 kPa"
        for size in Size
    }
    notes = (
        "The fits take hours and need the recordings, so this shows what `python benchmarks/real_beam.py` has found. "
        "Each recording has its own tilt; the fit of one beam alone predicts the other one with the tilt of the scene"
    )

    def tasks(self, size: Size) -> Sequence[Task]:
        """Return the task that reads what was measured."""
        typed = "python benchmarks/real_beam.py --recordings DIR"
        return [Reading("real_beam", 0.1, _read, typed, (MEASURED,))]

    def table(self, folders: Folders, size: Size) -> Table:
        """Return fit, E, low, high [kPa], bare and loaded [mm], holdout (1 if the loaded beam was predicted)."""
        fits = json.loads((folders["real_beam"] / "fits.json").read_text())
        return table_of(
            {
                "fit": label,
                "E": 1e-3 * entry["unknowns"][MODULUS]["value"],
                "low": 1e-3 * (entry["unknowns"][MODULUS]["interval"] or [np.nan] * 2)[0],
                "high": 1e-3 * (entry["unknowns"][MODULUS]["interval"] or [np.nan] * 2)[1],
                **{name: entry["recordings"][name]["rmse_mm"] for name in LIMITS},
                "holdout": float(entry["recordings"]["loaded"]["holdout"]),
            }
            for name, label in LABELS.items()
            if (entry := fits.get(name)) is not None
        )

    def draw(self, table: Table, size: Size, folders: Folders) -> Picture:
        """Draw moduli with their intervals, and errors beside their limits."""
        picture = new_figure(8.4, 3.4)
        left, right = picture.subplots(1, 2, sharey=True)
        y = -np.arange(len(table["fit"]))
        bars = np.stack([table["E"] - table["low"], table["high"] - table["E"]])
        left.errorbar(table["E"], y, xerr=np.nan_to_num(bars), fmt="o", color=COLOURS[0], capsize=3)
        left.axvspan(*RANGE, color=GREY, alpha=0.12, lw=0)
        left.set_yticks(y, table["fit"])
        left.set_xlabel("Young's modulus [kPa], 95 % interval")
        for colour, name in zip(COLOURS, LIMITS, strict=False):
            right.plot(table[name], y, "o", color=colour, label=name)
            right.axvline(LIMITS[name], color=colour, lw=0.8, ls=":")
        right.axvline(PREDICTED, color=COLOURS[1], lw=0.8, ls="--")
        holdout = table["holdout"] == 1
        right.plot(table["loaded"][holdout], y[holdout], "o", mfc="none", mec=COLOURS[1], ms=10, label="predicted")
        right.set_xlabel("error (RMS) [mm]; dotted and dashed: what is asked")
        right.set_xlim(left=0)
        right.legend()
        titled(left, self.title)
        return picture

    def judge(self, table: Table, size: Size) -> Verdict:
        """Judge errors and moduli."""
        fitted, holdout = table["holdout"] == 0, table["holdout"] == 1
        bare, loaded = float(table["bare"].max()), float(table["loaded"][fitted].max())
        predicted, E = float(table["loaded"][holdout].max()), table["E"]
        return Verdict.of({
            f"bare at most {bare:.2f} mm": bare <= LIMITS["bare"],
            f"loaded, fitted, at most {loaded:.2f} mm": loaded <= LIMITS["loaded"],
            f"loaded, predicted, at most {predicted:.2f} mm": predicted <= PREDICTED,
            f"E {E.min():.0f} to {E.max():.0f} kPa": bool(E.min() >= RANGE[0] and E.max() <= RANGE[1]),
        })  # fmt: skip


def _read(folder: Path, deadline: float) -> bool:
    write_json(folder / "fits.json", json.loads(MEASURED.read_text()))
    return True
