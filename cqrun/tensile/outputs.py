"""What is written of a material: a fragment for scenes (YAML), all laws as JSON, and a table for the terminal."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from cqrun.materials.curves import MODES, Mode
from cqrun.scene.document import write
from cqrun.tensile.choice import Judged
from cqrun.tensile.curve import Curve
from cqrun.tensile.laws import NU
from cqrun.tensile.material import Material, shown
from cqrun.tensile.relaxation import Relaxation

YAML, JSON, FIGURE = "material.yaml", "material.json", "material"
"""Names of the files of a material; that of the figure has no suffix."""

WIDTH = 110
"""Longest line of a comment."""

DIGITS = 10
"""Significant digits in a fragment: terms of a law may nearly cancel."""

SHORT: dict[Mode, str] = {"uniaxial": "uni.", "planar": "planar", "equibiaxial": "equi."}


def long_term(material: Material, relaxations: Sequence[Relaxation]) -> float | None:
    """Return the long-term moduli divided by those of the pull tests; None if it is not known how long they took."""
    times = [curve.duration for curve in material.curves]
    known = [time for time in times if time is not None]
    if not known or len(known) < len(times):
        return None
    return 1.0 / relaxations[0].prony.stiffening(float(np.median(known)))


def _factor(material: Material, relaxations: Sequence[Relaxation]) -> float:
    """Return the moduli that are written divided by those of the pull tests."""
    return (long_term(material, relaxations) or 1.0) if relaxations else 1.0


def about_long_term(material: Material | None, relaxations: Sequence[Relaxation]) -> list[str]:
    """Return a sentence on the moduli of a material with branches."""
    if material is None or not relaxations:
        return []
    factor, g = long_term(material, relaxations), float(relaxations[0].prony.moduli.sum())
    if factor is not None:
        return [f"with `prony` the moduli are the long-term ones: those of the pull test times {factor:.3g}"]
    return [
        f"with `prony` the moduli should be the long-term ones, {1 / (1 + g):.3g} to 1 times those of the pull test: "
        "its file does not say how long it took, so they are NOT converted"
    ]


def fragment(material: Material | None, relaxations: Sequence[Relaxation] = ()) -> dict[str, Any]:
    """Return the part of a scene's material that tests give.

    With relaxation, the law's moduli are long-term ones, as the term `prony` wants them.
    """
    found: dict[str, Any] = {}
    if material is not None:
        best = material.chosen
        factor = _factor(material, relaxations)
        moduli = np.array([factor if parameter.is_modulus else 1.0 for parameter in best.law.parameters])
        fields = best.law.made(best.fit.values * moduli, material.ratio)
        found["elastic"] = {best.law.name: {name: float(f"{x:.{DIGITS}g}") for name, x in fields.items()}}
    if relaxations:
        found |= relaxations[0].prony.fragment()
    return found


def fragment_text(material: Material | None, relaxations: Sequence[Relaxation] = (), title: str = "") -> str:
    """Return the YAML text of `fragment`, with what is known of it as comments."""
    lines = [
        title or "Material from tests (cqrun material). In a scene: material: {density: 1070, file: material.yaml}"
    ]
    if material is not None:
        best = material.chosen
        moduli = best.law.moduli(best.fit.values, material.ratio)
        for curve in material.curves:
            low, high = float(curve.stretch.min()), float(curve.stretch.max())
            of = f" ({curve.specimen})" if curve.specimen else ""
            lines.append(
                f"Source: {curve.source}{of}: {curve.mode}, {len(curve.stretch)} points, "
                f"stretch {low:.4g} to {high:.4g}"
            )
        error = f"error {best.fit.rms:.2%} (root mean square, relative to the largest stress)"
        lines.append(
            f"Law: {best.law.title}; {error}; stable in all three modes up to a stretch of {best.stable_to:.3g}"
        )
        factor = _factor(material, relaxations)
        when = "At rest" if factor == 1.0 else "At rest, after a long time"
        shear = _with_interval(factor * moduli.shear, _times(best.certainty.shear, factor))
        lines.append(f"{when}: mu = {shear}, E = {shown(factor * moduli.young)}")
        for parameter in best.law.parameters:
            interval = _times(best.certainty.intervals[parameter.name], factor if parameter.is_modulus else 1.0)
            lines.append(f"{parameter.name}: 95 % interval {_interval(interval, modulus=parameter.is_modulus)}")
        if material.ratio == NU:
            lines.append(f"Poisson's ratio {NU} is not measured; 0.49 is often enough, and takes larger time steps")
        lines += [f"Warning: {text}" for text in material.warnings]
        lines += [f"Trust: {text}" for text in material.trust]
    for relaxation in relaxations:
        lines += relaxation.sentences()
    lines += about_long_term(material, relaxations)
    comments = [part for line in lines for part in textwrap.wrap(line, WIDTH, subsequent_indent="  ")]
    return "".join(f"# {line}\n" for line in comments) + write(fragment(material, relaxations))


def as_json(material: Material | None, relaxations: Sequence[Relaxation] = ()) -> dict[str, Any]:
    """Return the content of material.json: the chosen law, all laws, and the tests; branches if a test relaxes.

    The branches are those of the first relaxation test, as in material.yaml. With branches, `laws` are as fitted to the
    pull tests. `long_term` has the chosen law as in material.yaml, and the factor of its moduli, or null.
    """
    laws, pulled = ((), ()) if material is None else (material.laws, material.curves)
    curves: list[tuple[Curve, float | None]] = [(curve, float(curve.stretch.max())) for curve in pulled]
    curves += [(each.curve, None if each.strain is None else 1.0 + each.strain) for each in relaxations]
    return {
        "chosen": None if material is None else material.chosen.law.name,
        "laws": {item.law.name: _law(item) for item in laws},
        "tests": [
            {
                "file": curve.source,
                "mode": curve.mode,
                "points": len(curve.stretch),
                "largest_stretch": stretch,
            }
            for curve, stretch in curves
        ],
        **(_branches(relaxations[0]) if relaxations else {}),
        **_long_term_part(material, relaxations),
    }


def _branches(relaxation: Relaxation) -> dict[str, Any]:
    prony = relaxation.prony
    known = {name: None if each is None else list(each) for name, each in prony.intervals.items()}
    return {**prony.fragment(), "prony_intervals": known}


def _long_term_part(material: Material | None, relaxations: Sequence[Relaxation]) -> dict[str, Any]:
    if material is None or not relaxations:
        return {}
    elastic = fragment(material, relaxations)["elastic"]
    return {"long_term": {"factor": long_term(material, relaxations), "elastic": elastic}}


def _law(item: Judged) -> dict[str, Any]:
    values = dict(zip((p.name for p in item.law.parameters), item.fit.values.tolist(), strict=True))
    intervals = item.certainty.intervals
    return {
        "parameters": {
            name: {"value": value, "interval": None if intervals[name] is None else list(intervals[name] or ())}
            for name, value in values.items()
        },
        "rms_relative": item.fit.rms,
        "stable_to": item.stable_to,
    }


def table(material: Material) -> Iterator[str]:
    """Yield the lines of a table of all laws for a terminal, then the chosen law, warnings and trust."""
    for curve in material.curves:
        yield f"{curve.source}: {curve.mode}, {len(curve.stretch)} points, stretch to {curve.stretch.max():.4g}"
        yield from (f"  {remark}" for remark in curve.remarks)
    yield ""
    modes = list(material.chosen.by_mode)
    several = len(modes) > 1
    head = f"{'law':16} {'error':>7}"
    if several:
        head += "".join(f" {SHORT[mode]:>8}" for mode in modes) + "".join(f" {'w/o ' + SHORT[m]:>10}" for m in modes)
    yield f"{head} {'AICc':>9} {'stable to':>10} {'mu at rest':>11}  parameters"
    for item in sorted(material.laws, key=lambda item: item.fit.rms):
        yield _line(item, modes if several else [], item is material.chosen)
    yield "error: root mean square, relative to the largest stress of each test; all points count alike"
    if several:
        yield "w/o: error of a mode as predicted by the law fitted to the other modes"
    yield "stable to: smallest stretch in uniaxial, planar or equibiaxial tension from which the stress falls"
    yield ""
    yield from _chosen(material)
    yield from (f"warning: {text}" for text in material.warnings)
    yield ""
    yield "how far it may be trusted:"
    yield from (f"  {text}" for text in material.trust)


def _line(item: Judged, modes: Sequence[Mode], is_chosen: bool) -> str:
    mark = "*" if is_chosen else " "
    moduli = item.law.moduli(item.fit.values)
    line = f"{mark}{item.law.title:15} {item.fit.rms:7.2%}"
    line += "".join(f" {item.by_mode[mode]:8.2%}" for mode in modes)
    line += "".join(f" {_percent(item.left_out[mode]):>10}" for mode in modes)
    ends = f"{item.stable_to:.3g}" + ("" if not item.unstable_in else "!")
    line += f" {item.criterion:9.1f} {ends:>10} {shown(moduli.shear):>11}"
    parameters = (f"{p.name} {x:.4g}" for p, x in zip(item.law.parameters, item.fit.values, strict=True))
    return f"{line}  {', '.join(parameters)}"


def _percent(error: float) -> str:
    return f"{error:.2%}" if error < 1.0 else "> 100%"


def _chosen(material: Material) -> Iterator[str]:
    best = material.chosen
    moduli = best.law.moduli(best.fit.values, material.ratio)
    yield f"chosen: {best.law.title} (marked *)"
    for parameter, value in zip(best.law.parameters, best.fit.values.tolist(), strict=True):
        text = shown(value) if parameter.is_modulus else f"{value:.4g}"
        interval = _interval(best.certainty.intervals[parameter.name], modulus=parameter.is_modulus)
        yield f"  {parameter.name:14} {text:>12}   95 % interval {interval}"
    ratio = moduli.young / moduli.shear
    shear = best.certainty.shear
    young = None if shear is None else (shear[0] * ratio, shear[1] * ratio)
    yield f"  {'mu at rest':14} {shown(moduli.shear):>12}   95 % interval {_interval(shear, modulus=True)}"
    yield f"  {'E at rest':14} {shown(moduli.young):>12}   95 % interval {_interval(young, modulus=True)}"
    stable = ", ".join(f"{mode} {best.stable[mode][1]:.3g}" for mode in MODES)
    yield f"  stable up to the stretch: {stable}"


def _interval(interval: tuple[float, float] | None, *, modulus: bool) -> str:
    if interval is None:
        return "none"
    low, high = (shown(x) if modulus else f"{x:.4g}" for x in interval)
    return f"{low} to {high}"


def _times(interval: tuple[float, float] | None, factor: float) -> tuple[float, float] | None:
    return None if interval is None else (factor * interval[0], factor * interval[1])


def _with_interval(value: float, interval: tuple[float, float] | None) -> str:
    return shown(value) + ("" if interval is None else f" (95 % interval {_interval(interval, modulus=True)})")
