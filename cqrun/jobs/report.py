"""What a run found, as lines for a terminal."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from cqrun.errors import UsageError
from cqrun.jobs.gradcheck import FILE as GRADCHECK
from cqrun.jobs.gradcheck import lines_of
from cqrun.learning.learned import STAGES, blown_up
from cqrun.scene.load import load_scene
from cqrun.scene.paths import leaf
from cqrun.scene.schema import Scene
from cqrun.store.run import read_record

MANY = 8
"""A block of more numbers is told by its range."""


def report_lines(run_dir: Path) -> list[str]:
    """Return what a finished run found; for one that goes on, its status.

    Raises:
        UsageError: it is no run, or what it found cannot be read.
    """
    record = read_record(run_dir)
    if record["job"] == "gradcheck":
        found = _read(run_dir / GRADCHECK)
        return [_status(record)] if found is None else lines_of(found)
    result = _read(run_dir / "result.json")
    if result is None:
        return [_status(record)]
    tell = {"sysid": lambda: _sysid(run_dir, result), "simulate": lambda: _simulate(result)}
    return [*tell.get(record["job"], lambda: _control(result))(), *_pictures(run_dir)]


def _read(path: Path) -> dict[str, Any] | None:
    if not path.exists():
        return None
    try:
        found: dict[str, Any] = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UsageError(f"{path}: unreadable ({error}); run the scene again with --fresh") from error
    return found


def _status(record: dict[str, Any]) -> str:
    return f"{record['job']}: {record['status']}" + (f" ({record['reason']})" if record.get("reason") else "")


# --- sysid --------------------------------------------------------------------------------------------------


def _sysid(run_dir: Path, result: dict[str, Any]) -> Iterator[str]:
    scene = load_scene(run_dir / "scene.yaml", (), Path(str(read_record(run_dir).get("base", ""))))
    yield f"{result['status']} after {result['iterations']} iterations: {result['message']}"
    yield ""
    yield from table(
        ("unknown", "value", "95 % interval", "unit", "from"),
        [row for path, entry in result["unknowns"].items() for row in _unknown(scene, path, entry)],
    )
    reasons = {path: entry["reason"] for path, entry in result["unknowns"].items() if entry.get("reason")}
    if reasons:
        yield ""
        if len(reasons) == len(result["unknowns"]) and len(set(reasons.values())) == 1:
            yield f"no intervals: {next(iter(reasons.values()))}"
        else:
            yield from (f"no interval for {path}: {reason}" for path, reason in reasons.items())
    yield ""
    yield from _errors(scene, result)
    yield from (f"note: {sentence}" for sentence in result.get("findings", []))


def _unknown(scene: Scene, path: str, entry: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    unit = leaf(scene, path).unit
    value, initial, interval = entry["value"], entry["initial"], entry["interval"]
    if not isinstance(value, list):
        yield path, number(value), _interval(interval), unit, number(initial)
    elif len(value) > MANY:
        yield path, f"{number(min(value))} ... {number(max(value))}", f"{len(value)} numbers", unit, number(initial[0])
    else:
        pairs = interval if interval is not None else [None] * len(value)
        for k, (v, i, pair) in enumerate(zip(value, initial, pairs, strict=True)):
            yield f"{path}[{k}]", number(v), _interval(pair), unit, number(i)


def _interval(pair: list[float] | None) -> str:
    return "none" if pair is None else f"{number(pair[0])} to {number(pair[1])}"


def _errors(scene: Scene, result: dict[str, Any]) -> Iterator[str]:
    if result["recordings"] is None:
        if result["loss"] is not None:
            yield f"loss {result['loss']:.6g} {scene.loss_unit}".rstrip()
        return
    assert scene.data is not None
    tables: dict[str, list[tuple[str, ...]]] = {}
    heads: dict[str, tuple[str, ...]] = {}
    for name, entry in result["recordings"].items():
        measured = scene.data.measurement(name)
        unit = f" [{measured.shown.name}]" if measured.shown.name else ""
        heads[measured.name] = ("recording", "", f"RMSE{unit}", f"by {measured.channel}{unit}")
        rmse, each = (entry.get(measured.error_key(word)) for word in ("rmse", f"{measured.channel}s"))
        told = [f"{key} {'unseen' if e is None else format(e, measured.digits)}" for key, e in (each or {}).items()]
        kind = "held out" if entry["holdout"] else "fitted"
        row = (name, kind, "blew up" if rmse is None else format(rmse, measured.digits))
        tables.setdefault(measured.name, []).append((*row, ", ".join(told) if len(told) <= 12 else ""))
    for kind, rows in tables.items():
        yield from table(heads[kind], rows)
    for name, entry in result["recordings"].items():
        if away := entry.get("alignment_mm", {}).values():
            yield f"{name}: aligned to the rest positions within {min(away):.2f} to {max(away):.2f} mm"


# --- control ------------------------------------------------------------------------------------------------


def _control(result: dict[str, Any]) -> Iterator[str]:
    yield f"{result['status']} after {result['iterations']} iterations: {result['message']}"
    columns = [name for name in STAGES if result[name] is not None]
    if not columns:
        return
    yield ""
    rows = [(term, *(number(result[c]["terms"][term]) for c in columns)) for term in result[columns[0]]["terms"]]
    rows.append(("loss", *(number(result[c]["loss"]) for c in columns)))
    yield from table(("term", *(STAGES[c] for c in columns)), rows)
    yield from blown_up(result)
    if result.get("constraints"):
        yield ""
        held = [(name, *_held(entry)) for name, entry in result["constraints"].items()]
        yield from table(("constraint", "wanted", "before", "learned", "violated by"), held)
    if result["unknowns"]:
        yield ""
        design = [(path, _range(e["initial"]), _range(e["value"]), _ends(e)) for path, e in result["unknowns"].items()]
        yield from table(("unknown", "before", "learned", "at its bounds"), design)


def _held(entry: dict[str, Any]) -> tuple[str, ...]:
    words = {"at_least": "at least", "at_most": "at most", "equals": ""}
    wanted = ", ".join(f"{word} {number(entry[end])}".strip() for end, word in words.items() if end in entry)
    return wanted, *(number(entry[stage]) for stage in ("start", "value", "violation") if stage in entry)


def _ends(entry: dict[str, Any]) -> str:
    """Return how many of an unknown's numbers are at its bounds."""
    ends = entry.get("at_bounds", {})
    count = len(entry["value"]) if isinstance(entry["value"], list) else 1
    found = ", ".join(f"{n:,} {end}" if count > 1 else end for end, n in ends.items() if n)
    return f"{found} of {count:,}" if found and count > 1 else found


def _range(value: Any) -> str:
    """Return one number, or the least, mean and greatest of many."""
    if not isinstance(value, list):
        return number(value)
    low, high, mean = min(value), max(value), sum(value) / len(value)
    return number(low) if low == high else f"{number(low)} to {number(high)}, mean {number(mean)}"


# --- simulate -----------------------------------------------------------------------------------------------


def _simulate(result: dict[str, Any]) -> Iterator[str]:
    yield f"{result['status']}: {result['message']}"
    yield ""
    rows = [
        (
            body,
            ", ".join(number(c) for c in entry["centroid"]),
            number(entry["fastest"]),
            number(entry["least_volume_ratio"]),
            number(entry["kinetic_energy"]),
        )
        for body, entry in result["bodies"].items()
    ]
    yield from table(("body", "centroid at the end [m]", "fastest [m/s]", "least volume ratio", "kinetic energy"), rows)
    if "terms" in result:
        values = {**result["terms"], "loss": result["loss"]}
        yield ""
        yield from table(("term", "value"), [(name, number(value)) for name, value in values.items()])
    if result.get("constraints"):
        held = [(name, *_held(entry)) for name, entry in result["constraints"].items()]
        yield ""
        yield from table(("constraint", "wanted", "value", "violated by"), held)
    yield from (f"note: {sentence}" for sentence in result["findings"])


# --- everywhere ---------------------------------------------------------------------------------------------


def _pictures(run_dir: Path) -> Iterator[str]:
    files = sorted((run_dir / "figures").glob("*.png"))
    files += [file for file in sorted(run_dir.glob("*.csv")) if file.name not in ("history.csv", "activation.csv")]
    files += sorted(run_dir.glob("trajectory.h5"))
    if files:
        yield ""
        yield "see " + ", ".join(str(file.relative_to(run_dir)) for file in files)


def number(value: float) -> str:
    """Return a number with five digits."""
    return f"{value:.5g}"


def table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> Iterator[str]:
    """Yield the lines of a table whose columns are as wide as they need to be."""
    widths = [max(len(row[k]) for row in (head, *rows)) for k in range(len(head))]
    for row in (head, *rows):
        yield "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
