"""Compare the records of a rollout with a recording: a loss, its residuals and its adjoint."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cqrun.engine.model import Records
from cqrun.measurements.placement import Placement
from cqrun.plugin.contract import Array

if TYPE_CHECKING:
    from scipy.sparse import csr_array

__all__ = ["Comparison", "Misfit", "Records"]


@dataclass(frozen=True)
class Misfit:
    """Root mean squares of the errors' lengths, in the measurement's unit.

    Attributes:
        total: over all channels and frames that were seen.
        channels: by channel; NaN for a channel that is not seen in the window.
    """

    total: float
    channels: dict[str, float]


class Comparison(ABC):
    """A number to minimise: it depends on a rollout's records, and on the time in the recording when the run begins.

    Attributes:
        rows: (K, N) weights of the sums over particles that the rollout records.
        count: number of squares whose mean is the loss.
        weight: weight in the loss, if there are other comparisons.
        remark: what a user should know about how the recording was made; may be empty.
        doubts: what looks wrong in the recording, and what is done about it.
        points: values by key path of each equilibrium that it is compared with; empty for a comparison with a motion.
    """

    rows: csr_array
    count: int = 1
    weight: float = 1.0
    remark: str = ""
    doubts: tuple[str, ...] = ()
    points: tuple[dict[str, float], ...] = ()

    @abstractmethod
    def residuals(self, records: Records, start: float) -> Array:
        """Return the errors (n,), whose squares sum to `count` times the loss."""

    @abstractmethod
    def loss(self, records: Records, start: float) -> float:
        """Return the loss."""

    @abstractmethod
    def loss_vjp(self, records: Records, start: float, loss_bar: float = 1.0) -> tuple[Records, float]:
        """Return the cotangents of the records and of `start` from that of the loss."""

    def placed(self, placement: Placement) -> Comparison:
        """Return the comparison with measured positions that are turned and moved.

        Only a measurement that takes `offset` and `rotation` is asked for a placement that moves anything.
        """
        return self

    def measured_vjp(self, records: Records, start: float, loss_bar: float = 1.0) -> tuple[Array, Array]:
        """Return the measured positions (n, D) [m] and their cotangents, from that of the loss."""
        raise NotImplementedError(f"{type(self).__name__} has no positions that could be placed")

    def from_rest(self, records: Records) -> Comparison:
        """Return the comparison with changes counted from the rest shape, whose records are given.

        A run that begins at equilibrium does not begin there.
        """
        return self

    @property
    def size(self) -> int:
        """Number of residuals n."""
        return self.count

    def too_early(self, start: float) -> str:
        """Return why a start is too early, so that the run ends before the last compared frame; empty if it is not."""
        return ""

    def series(self) -> Sequence[tuple[Array, Array, Array]]:
        """Return the time series among the residuals: places, frames, values in the still frames; none by default.

        Places and frames are in order of time.
        """
        return ()

    def misfit(self, records: Records, start: float) -> Misfit:
        """Return the root mean square errors."""
        return Misfit(float(np.sqrt(self.loss(records, start))), {})

    def details(self, records: Records, start: float) -> dict[str, float | dict[str, float | None]]:
        """Return further errors for result.json, by a key that ends in their unit; none by default."""
        return {}

    def findings(self, records: Records, start: float) -> Iterator[str]:
        """Yield what a user should know about the errors; nothing by default."""
        yield from ()

    def facts(self) -> dict[str, Any]:
        """Return facts about the recording itself for result.json; nothing by default."""
        return {}

    def wanted(self) -> dict[str, Any]:
        """Return the target positions that a trajectory stores for pictures; nothing by default."""
        return {}

    def summary(self) -> str:
        """Describe the comparison for `cqrun validate`; nothing by default."""
        return ""

    def table(self, records: Records, start: float) -> Iterator[list[object]]:
        """Yield the rows of the table of data and model; the first row names the columns."""
        yield from ()
