"""A body's deformation in few numbers: coordinates along its principal components in earlier runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from pydantic import Field

from cqrun.errors import UsageError
from cqrun.observers.matter import Matter
from cqrun.observers.npz import not_numbers, read_arrays, write_arrays
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
        mean: (N, D) mean displacement [m], relative to the centroid's.
        reach: (k,) largest absolute coordinate along each mode in the fitted trajectories [m].
        explained: (k,) share of the variance that each mode explains.
    """

    modes: Array
    mean: Array
    reach: Array
    explained: Array


@plugin("observer", "pca")
class Pca(Observer):
    """Coordinates [m] of a body's displacement along its principal components.

    A displacement is measured from the rest position, and the centroid's displacement is subtracted: the components
    describe how the body is bent, not where it is. `cqrun compress --method pca` fits them to trajectories of the same
    body and writes them to a file.
    """

    body: BodyName = Field(description="Body that is observed")
    components: int = Field(description="Number of components", ge=1)
    file: FileName | None = Field(
        description="File (.npz) of the components, made by `cqrun compress`; a run needs it", default=None
    )
    range: Range = Field(
        description="[low, high] in m that is scaled to [-1, 1]; auto: the range of the fitted trajectories; or null",
        default="auto",
    )

    def bind(self, matter: Matter) -> BoundObserver:
        if self.file is None:
            raise UsageError(
                "the pca has no components: give a `file` of them, which `cqrun compress RUN... --method pca` makes"
            )
        return self.bind_to(matter, load_components(self.path_of(self.file)))

    def bind_to(self, matter: Matter, fitted: Components) -> BoundObserver:
        """Bind this observer to a scene's particles, with the first of these components.

        Raises:
            UsageError: there are too few, or they belong to another body.
        """
        members = matter.members(self.body)
        k, n, dim = fitted.modes.shape
        if (n, dim) != (len(members), matter.dim):
            raise UsageError(
                f"the components are of a {dim}D body of {n} particles; '{self.body}' has {len(members)} in "
                f"{matter.dim}D: fit them to this body"
            )
        if k < self.components:
            raise UsageError(f"`components` is {self.components}, but only {k} were fitted: give at most {k}")
        return PrincipalCoordinates(self, matter, members, fitted)


class PrincipalCoordinates(BoundObserver):
    """z_k = sum over particles and axes of mode_k (x - rest - mean): one row a component and axis."""

    def __init__(self, spec: Pca, matter: Matter, members: Array, fitted: Components) -> None:
        self.size = spec.components
        modes = fitted.modes[: self.size]
        weights = modes.transpose(0, 2, 1).reshape(-1, len(members))
        self.rows = weighted([members] * len(weights), list(weights), matter.n_particles)
        self.offset = np.einsum("knd,nd->k", modes, matter.x[members] + fitted.mean)
        reach = fitted.reach[: self.size]
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
        k: number of components.
        starts: frames at which a motion begins. Each motion is measured from its own first frame, as bodies of several
            runs may differ in shape.

    Raises:
        UsageError: the trajectory has fewer than k components.
    """
    start_of = np.searchsorted(starts, np.arange(len(x)), side="right") - 1
    displacement = x - x[np.asarray(starts)[start_of]]
    displacement = displacement - displacement.mean(axis=1, keepdims=True)
    mean = displacement.mean(axis=0)
    centred = (displacement - mean).reshape(len(x), -1)
    _, s, Vt = np.linalg.svd(centred, full_matrices=False)
    rank = int(np.count_nonzero(s > max(centred.shape) * np.finfo(float).eps * s[0]))
    if rank < k:
        raise UsageError(f"the trajectory deforms the body in {rank} ways; {k} components cannot be fitted to it")
    modes = Vt[:k]
    largest = np.abs(modes).argmax(axis=1)
    modes = modes * np.sign(modes[np.arange(k), largest])[:, None]  # each mode's largest entry is positive
    reach = np.abs(centred @ modes.T).max(axis=0)
    return Components(modes.reshape(k, *x.shape[1:]), mean, reach, s[:k] ** 2 / np.sum(s**2))


def save_components(path: Path, components: Components) -> None:
    """Write components for `pca: {file: ...}`; OSError if that fails."""
    write_arrays(path, asdict(components))


def load_components(path: Path) -> Components:
    """Read components; UsageError if the file contains none."""
    arrays = read_arrays(path, "a file of principal components")
    dimensions = {"modes": 3, "mean": 2, "reach": 1, "explained": 1}
    if {name: array.ndim for name, array in arrays.items()} != dimensions:
        raise UsageError(
            f"{path}: is not a file of principal components: it must contain the arrays {', '.join(dimensions)}"
        )
    if bad := not_numbers(arrays):
        raise UsageError(f"{path}: {', '.join(bad)} of the components are not finite numbers")
    k, *matrix = arrays["modes"].shape
    for name, expected in (("mean", (*matrix,)), ("reach", (k,)), ("explained", (k,))):
        if arrays[name].shape != expected:
            shapes = " x ".join(map(str, arrays[name].shape)), " x ".join(map(str, expected))
            raise UsageError(f"{path}: its {name} is {shapes[0]}, but {shapes[1]} fits its modes; fit it again")
    return Components(**arrays)
