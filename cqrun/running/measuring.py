"""Measure the quantities that a scene names, moment by moment, during a run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.build.measures import bound_measures
from cqrun.build.model import Built
from cqrun.engine.model import Inputs, Records
from cqrun.errors import CrushedError
from cqrun.measures.measure import BoundMeasure
from cqrun.observers.track import Track
from cqrun.plugin.contract import Array
from cqrun.running.tables import number, table
from cqrun.state import State
from cqrun.store.measured import TABLE, MeasuredNumber, MeasuredQuantities, Quantity
from cqrun.store.result import GradcheckResult, Result


class Measuring:
    """Collects the measured quantities of one run.

    Args:
        built: the scene.
        values: numbers by path that replace the scene's.

    Attributes:
        bound: the quantities by name; empty if the scene names none.
        late: those that are known only at the end, from what boundaries and rigid bodies did.
        found: all that was measured, after `end`; None if the scene names nothing.

    Raises:
        SceneError: a quantity does not fit the scene.
    """

    def __init__(self, built: Built, values: Mapping[str, Array] | None = None) -> None:
        self.built = built
        self.bound = bound_measures(built, values)
        self.found: MeasuredQuantities | None = None
        self.late = {name for name, chosen in built.scene.measure.items() if chosen.value.known_late}  # type: ignore[attr-defined]
        self._before: dict[str, Track] = {}  # the last moment of cumulative quantities
        self._rows: dict[str, list[Array]] = {name: [] for name in self.bound if name not in self.late}

    def look(self, state: State, inputs: Inputs, activation: Array) -> None:
        """Measure at a moment.

        Args:
            state: of all particles.
            inputs: of the run.
            activation: (A,) that acted up to this moment; at the start, those that act first.
        """
        for name, rows in self._rows.items():
            bound = self.bound[name]
            now = _moment(bound, state, inputs, activation, self.built)
            try:
                rows.append(bound.values(_joined(self._before.get(name, now), now) if bound.cumulative else now)[-1])
            except CrushedError:  # a crushed part has no rotation
                rows.append(np.full(len(bound.components), np.nan))
            if bound.cumulative:
                self._before[name] = now

    def end(self, records: Records, *, at_rest: bool = False) -> MeasuredQuantities | None:
        """Return all that was measured; None if the scene names nothing.

        Args:
            records: what boundaries and rigid bodies did; empty if the run failed.
            at_rest: whether the moments were points at rest.
        """
        if not self.bound:
            return None
        found = {name: self.bound[name].continuous(np.array(rows)) for name, rows in self._rows.items()}
        for name in [name for name in found if self.bound[name].cumulative]:  # points at rest are no steps of a motion
            found[name] = np.full(found[name].shape, np.nan) if at_rest else np.cumsum(found[name], axis=0)
        both = [*records.held.values(), *records.rigid.values()]
        moments = max([*map(len, found.values()), *map(len, both)], default=0)
        step = 1.0 if at_rest else self.built.scene.time.control_step
        for name in self.late:
            found[name] = np.full((moments, len(self.bound[name].components)), np.nan)
            if both:
                values = self.bound[name].values(_of_boundaries(records, moments, self.built.scene.dim, step))
                found[name] = self.bound[name].continuous(values)
        quantities = {
            name: Quantity(found[name], bound.components, bound.unit, bound.meaning)
            for name, bound in self.bound.items()
        }
        self.found = MeasuredQuantities(step * np.arange(moments), quantities, at_rest)
        return self.found


def _moment(bound: BoundMeasure, state: State, inputs: Inputs, activation: Array, built: Built) -> Track:
    """Return what a quantity reads of a moment, as a record with one row."""
    x, v, C, F = (
        (bound.rows @ part.reshape(len(part), -1)).reshape(1, -1, *part.shape[1:])
        for part in (state.x, state.v, state.C, state.F)
    )
    return Track(
        x, v, C, F, activation[None], {}, built.scene.time.control_step, built.assembly.design(inputs), {},
        inputs.strength, inputs.rest, inputs.terms, inputs.weights, inputs.state.x,
        inputs.friction,
    )  # fmt: skip


def _joined(before: Track, now: Track) -> Track:
    """Return the record of two moments."""
    both: dict[str, Any] = {
        name: np.concatenate([getattr(before, name), getattr(now, name)]) for name in ("x", "v", "C", "F")
    }
    return replace(now, **both)


def _of_boundaries(records: Records, moments: int, dim: int, control_step: float) -> Track:
    """Return a track that knows what boundaries and rigid bodies do, and no particles."""
    none, matrices = np.zeros((moments, 0, dim)), np.zeros((moments, 0, dim, dim))
    activation = np.zeros((0, 0))
    return Track(none, none, matrices, matrices, activation, {}, control_step, held=records.held, rigid=records.rigid)


def write_measured(run: Path, measuring: Measuring, result: Result) -> None:
    """Write the table of what was measured, and put its summary into the result, if anything was measured."""
    if measuring.found is not None and not isinstance(result, GradcheckResult):
        measuring.found.write_table(run / TABLE)
        result.measured = measuring.found.summary()


def measured_lines(measured: Mapping[str, MeasuredNumber]) -> Iterator[str]:
    """Yield the table of measured quantities for a terminal; nothing if there are none."""
    if measured:
        rows = [(name, m.unit, *map(number, (m.start, m.end, m.least, m.largest))) for name, m in measured.items()]
        yield ""
        yield from table(("measured", "unit", "at the start", "at the end", "least", "largest"), rows)
