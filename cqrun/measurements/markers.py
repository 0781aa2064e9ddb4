"""Markers on a body, seen by cameras: where they are, or how far they have moved."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import ConfigDict, Field
from pydantic_core import ErrorDetails, InitErrorDetails
from scipy import sparse

from cqrun.engine.model import Records
from cqrun.errors import DataError
from cqrun.explain import Loc, reworded
from cqrun.measurements.alignment import Alignment, Measured, measure
from cqrun.measurements.measurement import Measurement, Recorded
from cqrun.measurements.placement import Placement
from cqrun.measurements.plausible import plausible
from cqrun.measurements.points import Points, markers
from cqrun.measurements.recording import Recording
from cqrun.measurements.series import SeriesComparison
from cqrun.measurements.window import Window
from cqrun.observers.matter import Matter
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin
from cqrun.units import METRES, Unit

MILLI = 1e3

WITHOUT_STILL = (
    "without `still` frames positions are in the scene's own frame; give `still`, or mend the rest positions"
)

RestPosition = Annotated[list[float], Field(min_length=2, max_length=3)]


@plugin("measurement", "markers")
class Markers(Measurement):
    """Motion of markers on a body: `{NAME: [x, y(, z)]}` gives the rest position of each marker in the scene [m].

    If the recording has `still` frames, its axes are aligned to the rest positions, and each marker's displacement from
    its mean over these frames is compared. If not, positions in the axes of the scene are compared. A marker off the
    body stands on a rigid stem. What is compared is turned by `rotation`, and `offset` is added, for all
    markers alike; as unknowns they absorb that the cameras' axes are not known exactly.

    The file is C3D, a trajectory.h5, TRC, text of Motive, Vicon or Qualisys, or a table: with the columns time, marker,
    x, y(, z), or with a column for each coordinate such as tip_x. docs/recordings.md has an example of each.

    A gap is a missing line, an empty cell, `nan`, or a negative residual in C3D. Exact zeros, and leaps that no body
    makes, count as not seen, and are reported. Times in a C3D or Vicon file count from the first frame in the file,
    whatever its number is.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, RestPosition]

    quantity: ClassVar[str] = "displacement"
    unit: ClassVar[str] = "m"
    shown: ClassVar[Unit] = Unit("mm", MILLI)
    digits: ClassVar[str] = ".3f"
    channel: ClassVar[str] = "marker"
    table: ClassVar[str] = "tracks"
    takes: ClassVar[frozenset[str]] = frozenset({"still", "units", "offset", "rotation"})

    @classmethod
    def _reworded(cls, error: ErrorDetails) -> InitErrorDetails:
        return reworded(error, unit=cls.unit)

    @property
    def rest(self) -> dict[str, Array]:
        """Rest position of each marker (D,) [m]."""
        return {name: np.array(position) for name, position in self.__pydantic_extra__.items()}

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        message = f"must have {dim} entries in this {dim}D world, has "
        wrong = {name: len(x) for name, x in self.rest.items() if len(x) != dim}
        return super().dim_problems(dim) + [((name,), f"{message}{n}") for name, n in wrong.items()]

    def bind(self, recorded: Recorded, matter: Matter) -> SeriesComparison:
        reach, window = _reach(matter, recorded.body), recorded.window
        recording = recorded.read_markers(list(self.rest))
        span = (window.bounds[0], window.bounds[1] + window.length)
        recording, doubts = plausible(recording, reach, _with(span, recorded.still))
        measured = measure(recording, self.rest, recorded.still)
        observer = observe_markers(matter, recorded.body, dict(zip(measured.names, measured.rest, strict=True)))
        if measured.absolute:
            require_near(matter, recorded.body, measured, recorded.placement)
        return MarkerComparison(
            self, recorded, observer, over_body(observer.rows, recorded.body, matter), measured.names, measured.time,
            measured.values, still=measured.still, relative=not measured.absolute, alignment=measured.alignment,
            remark=str(measured.alignment or "positions in the scene's own frame"), doubts=doubts,
        )  # fmt: skip


def _with(span: tuple[float, float], still: tuple[float, float] | None) -> tuple[float, float]:
    """Return the span that holds the still frames, too [s]."""
    return span if still is None else (min(span[0], still[0]), max(span[1], still[1]))


class MarkerComparison(SeriesComparison):
    """Markers that were seen, beside the model's; arguments as `SeriesComparison`, and:

    Args:
        observer: of the markers, over the body's particles.
        alignment: of the recording to the scene; None if it was in the scene's frame already.
    """

    def __init__(
        self, spec: Measurement, recorded: Recorded, observer: Points, *series: Any,
        alignment: Alignment | None = None, **options: Any,
    ) -> None:  # fmt: skip
        super().__init__(spec, recorded, *series, **options)
        self.observer, self.alignment = observer, alignment

    def observe(self, records: Records) -> tuple[Array, Array]:
        """Return positions [m] and velocities [m/s] of the markers, both (T+1, M, D)."""
        return self.observer.observe(records)

    def observe_vjp(self, records: Records, y_bar: Array, w_bar: Array) -> Records:
        """Return the cotangent of the records from those of positions and velocities, both (T+1, M, D)."""
        return self.observer.observe_vjp(records, y_bar, w_bar)

    def facts(self) -> dict[str, Any]:
        """Return how far each marker is from its rest position after alignment [mm]."""
        if self.alignment is None:
            return {}
        return {"alignment_mm": dict(zip(self.names, (MILLI * self.alignment.residuals).tolist(), strict=True))}


def in_the_scenes_frame(
    recording: Recording, observer: Points, rows: sparse.csr_array, window: Window
) -> MarkerComparison:
    """Return the comparison of points with where they were in the scene's own frame, as a scene's own data have it.

    Args:
        recording: of the points.
        observer: of them, over their body's particles.
        rows: the observer's, over all particles of the scene.
        window: which frames are compared.
    """
    recorded = Recorded(Path(recording.source), "", window, lambda: recording)
    return MarkerComparison(Markers(), recorded, observer, rows, recording.names, recording.time, recording.positions)


def over_body(rows: sparse.csr_array, body: str, matter: Matter) -> sparse.csr_array:
    """Return rows over a body's particles (M, N_b) as rows over all of a scene's (M, N)."""
    columns = rows.indices + matter.bodies[body].start
    return sparse.csr_array((rows.data, columns, rows.indptr), shape=(rows.shape[0], matter.n_particles))


def observe_markers(matter: Matter, body: str, rest: Mapping[str, Array]) -> Points:
    """Return the observer of markers, by name and rest position, on the body that carries them.

    Raises:
        DataError: one is farther from the body than this is across.
    """
    x, reach = matter.x[matter.bodies[body]], _reach(matter, body)
    observer = markers(np.array(list(rest.values())), x, matter.spacing[body])
    stems = np.zeros(len(rest)) if observer.stems is None else np.linalg.norm(observer.stems, axis=1)
    for name, stem in zip(rest, stems, strict=True):
        if stem > reach:
            raise DataError(
                f"marker '{name}' is {stem:.3g} m from the body '{body}', which is {reach:.3g} m across: "
                "give its rest position in the scene's own coordinates, in metres"
            )
    return observer


def _reach(matter: Matter, body: str) -> float:
    """Return how far a body is across [m]."""
    x = matter.x[matter.bodies[body]]
    return max(float(np.linalg.norm(x.max(axis=0) - x.min(axis=0))), matter.spacing[body])  # of one particle


def require_near(
    matter: Matter, body: str, measured: Measured, placement: Placement | None, otherwise: str = WITHOUT_STILL
) -> None:
    """Raise a DataError for positions that are never near where their markers are at rest.

    Args:
        placement: of the positions in the axes of the scene, or None.
        otherwise: advice if no other unit explains it.
    """
    reach = _reach(matter, body)
    away = np.linalg.norm((placement.of(measured.values) if placement else measured.values) - measured.rest, axis=2)
    for name, distances in zip(measured.names, away.T, strict=True):
        nearest = np.nanmin(distances, initial=np.inf)
        if np.isfinite(nearest) and nearest > reach:
            raise DataError(
                f"{measured.source}: marker '{name}' is never nearer than {nearest:.3g} m to where it is at rest, and "
                f"the body is {reach:.3g} m across: {_advice(measured, reach, otherwise)}"
            )


def _advice(measured: Measured, reach: float, otherwise: str) -> str:
    """Return what would bring positions near where their markers are at rest."""
    for unit, factor in METRES.items():
        away = np.nanmin(np.linalg.norm(factor * measured.values - measured.rest, axis=2), axis=0)  # all were seen
        near = np.minimum(reach, 0.5 * np.linalg.norm(measured.rest, axis=1))  # the origin alone tells nothing
        if unit != "m" and (away <= near).all():
            return f"the file looks as if it is in {unit}: say `units: {unit}`"
    return otherwise
