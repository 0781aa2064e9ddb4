"""Deformation in few numbers: its principal components over runs that were seen before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from pydantic import Field

from cqrun.errors import UsageError
from cqrun.observers.matter import Matter
from cqrun.observers.npz import read_arrays, write_arrays
from cqrun.observers.observer import BoundObserver, Moment, MomentBar, Observer
from cqrun.observers.ranges import Range, limits
from cqrun.observers.rows import weighted
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import BodyName, FileName
from cqrun.plugin.registry import plugin


@dataclass(frozen=True)
class Components:
    """Principal components of a body's deformation.

    Attributes:
        modes: (k, N, D) orthonormal; none of them moves the centroid.
        mean: (N, D) mean displacement [m], less that of the centroid.
        reach: (k,) the largest coordinate along each that was seen [m].
        explained: (k,) share of the variance that each explains.
    """

    modes: Array
    mean: Array
    reach: Array
    explained: Array


@plugin("observer", "pca")
class Pca(Observer):
    """Coordinates [m] of a body's displacement along its principal components.

    Displacements are counted from rest and from the centroid, so that the components describe how the body is
    bent, not where it is. They come from a file that `cqrun compress --method pca` fits to trajectories of the same
    body.
    """

    body: BodyName = Field(description="Body that is observed")
    components: int = Field(description="How many components", ge=1)
    file: FileName | None = Field(
        description="File (.npz) of the components, made by `cqrun compress`; a run needs it", default=None
    )
    range: Range = Field(
        description="[low, high] in m that becomes [-1, 1]; auto: what was reached in the fit, or null", default="auto"
    )

    def bind(self, matter: Matter) -> BoundObserver:
        if self.file is None:
            raise UsageError(
                "the pca has no components: give a `file` of them, which `cqrun compress RUN... --method pca` makes"
            )
        return self.bind_to(matter, load_components(self.path_of(self.file)))

    def bind_to(self, matter: Matter, found: Components) -> BoundObserver:
        """Return this observer along the first of the components that were found.

        Raises:
            UsageError: there are too few, or they belong to another body.
        """
        members = matter.members(self.body)
        k, n, dim = found.modes.shape
        if (n, dim) != (len(members), matter.dim):
            raise UsageError(
                f"the components are of a {dim}D body of {n} particles; '{self.body}' has {len(members)} in "
                f"{matter.dim}D: fit them to this body"
            )
        if k < self.components:
            raise UsageError(f"{self.components} components are wanted, {k} were fitted: ask for fewer")
        return PrincipalCoordinates(self, matter, members, found)


class PrincipalCoordinates(BoundObserver):
    """z_k = sum over particles and axes of mode_k (x - rest - mean): one row a component and axis."""

    def __init__(self, spec: Pca, matter: Matter, members: Array, found: Components) -> None:
        self.size = spec.components
        modes = found.modes[: self.size]
        weights = modes.transpose(0, 2, 1).reshape(-1, len(members))
        self.rows = weighted([members] * len(weights), list(weights), matter.n_particles)
        self.offset = np.einsum("knd,nd->k", modes, matter.x[members] + found.mean)
        reach = found.reach[: self.size]
        self.low, self.high = limits(spec.range, -reach, reach)

    def observe(self, moment: Moment) -> tuple[Array, Array]:
        dim = moment.x.shape[1]
        return np.einsum("kdd->k", moment.x.reshape(self.size, dim, dim)) - self.offset, np.zeros(0)

    def observe_vjp(self, moment: Moment, z_bar: Array, memory_next_bar: Array) -> MomentBar:
        dim = moment.x.shape[1]
        return MomentBar(x=(z_bar[:, None, None] * np.eye(dim)).reshape(moment.x.shape))


def fit_components(x: Array, k: int, starts: Sequence[int] = (0,)) -> Components:
    """Return the k principal components of a body's deformation by singular values.

    Args:
        x: (T, N, D) positions of the body's particles [m].
        k: how many.
        starts: frames at which a motion begins; each counts from its own rest there, as bodies may differ in shape.

    Raises:
        UsageError: the trajectory deforms in fewer than k ways.
    """
    begun = np.searchsorted(starts, np.arange(len(x)), side="right") - 1
    displacement = x - x[np.asarray(starts)[begun]]
    displacement = displacement - displacement.mean(axis=1, keepdims=True)
    mean = displacement.mean(axis=0)
    centred = (displacement - mean).reshape(len(x), -1)
    _, s, Vt = np.linalg.svd(centred, full_matrices=False)
    rank = int(np.count_nonzero(s > max(centred.shape) * np.finfo(float).eps * s[0]))
    if rank < k:
        raise UsageError(f"the trajectory deforms the body in {rank} ways; {k} components cannot be fitted to it")
    modes = Vt[:k]
    largest = np.abs(modes).argmax(axis=1)
    modes = modes * np.sign(modes[np.arange(k), largest])[:, None]  # of the two signs, always the same one
    reach = np.abs(centred @ modes.T).max(axis=0)
    return Components(modes.reshape(k, *x.shape[1:]), mean, reach, s[:k] ** 2 / np.sum(s**2))


def save_components(path: Path, components: Components) -> None:
    """Write components for `pca: {file: ...}`; OSError where the disk refuses."""
    write_arrays(path, asdict(components))


def load_components(path: Path) -> Components:
    """Read components; UsageError where the file is none of theirs."""
    arrays = read_arrays(path, "file of principal components")
    wanted = {"modes": 3, "mean": 2, "reach": 1, "explained": 1}
    if {name: array.ndim for name, array in arrays.items()} != wanted:
        raise UsageError(f"{path}: is no file of principal components: it must hold the arrays {', '.join(wanted)}")
    return Components(**arrays)
