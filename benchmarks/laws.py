"""What a law of the material costs: forward and gradient of a block in each frame, divided by that of fixed corotated.

    python -m benchmarks.laws [--edge 20] [--rounds 15] [--only LAW ...] [--out FILE]

writes benchmarks/measured/laws.csv. `--edge 40` is a block that no cache holds. The laws take turns, so that a change
of the machine's speed meets all of them. The numbers are medians over the rounds, on one thread.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.engine.frames import make_rollout
from cqrun.engine.model import GroupModel
from cqrun.jobs.bench import falling_block
from cqrun.materials.prony import Prony
from cqrun.plugin.registry import plugins
from cqrun.running.excerpt import Excerpt
from cqrun.state import Layout, State

OUT = Path(__file__).parent / "measured" / "laws.csv"
SUBSTEPS = 64
"""Of a control step: those of scenes are more."""

MU = 10.0 / 2.6
"""Shear modulus of the block of `cqrun bench` [Pa]."""

LAWS: dict[str, tuple[str, dict[str, float]]] = {
    "fixed_corotated": ("fixed_corotated", {"youngs_modulus": 10.0, "poissons_ratio": 0.3}),
    "neo_hookean": ("neo_hookean", {"youngs_modulus": 10.0, "poissons_ratio": 0.3}),
    "mooney_rivlin": ("mooney_rivlin", {"c10": 0.4 * MU, "c01": 0.1 * MU, "poissons_ratio": 0.3}),
    "yeoh": ("yeoh", {"c10": 0.5 * MU, "c20": 0.1, "c30": 0.01, "poissons_ratio": 0.3}),
    "gent": ("gent", {"mu": MU, "jm": 30.0, "poissons_ratio": 0.3}),
    "arruda_boyce": ("arruda_boyce", {"mu": MU, "lock": 3.0, "poissons_ratio": 0.3}),
    "ogden, 1 term": ("ogden", {"mu_1": MU, "alpha_1": 2.2, "poissons_ratio": 0.3}),
    "ogden, 3 terms": (
        "ogden",
        {
            "mu_1": 0.6 * MU, "alpha_1": 1.3, "mu_2": 0.01 * MU, "alpha_2": 5.0, "mu_3": -0.3 * MU, "alpha_3": -2.0,
            "poissons_ratio": 0.3,
        },
    ),
}  # fmt: skip
BRANCHES = {"yeoh + prony, 1 branch": ("yeoh", 1), "yeoh + prony, 2 branches": ("yeoh", 2)}


def excerpt(name: str, frame: str, edge: int, real: Any) -> Excerpt:
    """Return a few substeps of a block of a law, or of one with branches."""
    model, inputs = falling_block(3, edge, real)
    law, n = BRANCHES.get(name, (name, 0))
    spec = plugins("elastic")[LAWS[law][0]](**LAWS[law][1])
    specs: list[Any] = [spec]
    if n:
        specs.append(Prony(**{f"{key}_{k}": 0.1 for k in range(1, n + 1) for key in ("ratio", "time")}))
        specs[1].bind(spec)
    count = model.layout.n_particles
    thetas = [np.array([np.full(count, getattr(s, p, None) or getattr(spec, p)) for p in s.parameters]) for s in specs]
    fields = [[f._replace(name=f"{s.name}.{f.name}") for f in s.history(3)] for s in specs]
    group = GroupModel(
        (0,), tuple(s.kernel_term for s in specs), (), tuple(tuple(f.name for f in own) for own in fields),
        tuple(s.shear_modulus for s in specs), tuple(s.wave_modulus for s in specs),
    )  # fmt: skip
    history = tuple(field for own in fields for field in own)
    state = inputs.state
    if frame == "reference":  # its motions start from the rest shape
        state.F[:] = np.eye(3)
    if history:
        blank = State.at_rest(state.x, history)
        blank.v[:], blank.F[:] = state.v, state.F
        state = blank
    layout = Layout(3, (count,), history)
    model = replace(model, groups=(group,), layout=layout, frame=frame, substeps=SUBSTEPS)
    inputs = replace(inputs, state=state, terms=[thetas])
    return Excerpt(make_rollout(model, inputs, adjoint=True), 0, SUBSTEPS)


def measured(frame: str, edge: int, rounds: int, real: Any, names: list[str]) -> Iterator[dict[str, Any]]:
    """Yield a row for each law: ns per particle and substep, and ratios to fixed corotated."""
    names = [name for name in (*LAWS, *BRANCHES) if name in {"fixed_corotated", "yeoh", *names}]
    benches = {name: excerpt(name, frame, edge, real) for name in names}
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
    for _ in range(rounds):
        for name, bench in benches.items():
            found = bench.measure(1)
            times[name].append((found["forward"], found["store"] + found["backward"]))
    base = np.array(times["fixed_corotated"])
    plain = np.array(times["yeoh"])
    for name in names:
        own = np.array(times[name])
        ratio = np.median(own / base, axis=0)
        row = {"frame": frame, "precision": np.dtype(real).name, "law": name, "particles": benches[name].n}
        for what, column, times_base in (("forward", own[:, 0], ratio[0]), ("gradient", own[:, 1], ratio[1])):
            row |= {f"{what}_ns": round(float(np.median(column)), 1), f"{what}_ratio": round(float(times_base), 3)}
        row["forward_over_yeoh"] = round(float(np.median(own[:, 0] / plain[:, 0])), 3) if name in BRANCHES else ""
        yield row


def main() -> None:
    """Measure all laws and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--edge", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--only", nargs="+", choices=[*LAWS, *BRANCHES], default=[*LAWS, *BRANCHES])
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args()
    rows = []
    for frame in ("updated", "reference"):
        for row in measured(frame, options.edge, options.rounds, np.float64, options.only):
            rows.append(row)
            print(*row.values(), sep="  ", flush=True)
    with options.out.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
