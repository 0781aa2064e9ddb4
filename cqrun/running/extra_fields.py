"""Fields of all particles that a scene asks for in its trajectory: strain and stress."""

from __future__ import annotations

import numpy as np

from cqrun.build.matter import matter_of
from cqrun.build.model import Built
from cqrun.engine.model import Inputs
from cqrun.errors import Problem, SceneError, UsageError
from cqrun.measures.material import MeanStress, Stress
from cqrun.observers.track import Track
from cqrun.plugin.contract import Array
from cqrun.state import State


class ExtraFields:
    """The fields beside positions, velocities and volume ratios.

    Args:
        built: the scene.

    Attributes:
        shapes: shape of each field after (T, N), by name.

    Raises:
        SceneError: the stress of a body is not known.
    """

    def __init__(self, built: Built) -> None:
        dim, wanted = built.scene.dim, built.scene.trajectory.fields
        self.shapes: dict[str, tuple[int, ...]] = {name: (dim * (dim + 1) // 2,) for name in wanted}
        self._built = built
        self._stress: dict[str, MeanStress] = {}
        if "stress" in wanted:
            matter = matter_of(built, {})
            try:
                self._stress = {name: MeanStress(Stress(body=name), matter) for name in built.particles.names}
            except UsageError as error:
                path = "trajectory.fields"
                raise SceneError([Problem(built.scene.where(path), path, str(error))]) from error

    def at(self, state: State, inputs: Inputs) -> dict[str, Array]:
        """Return the fields of a state (N, ...), by name."""
        out = {}
        if "strain" in self.shapes:
            i, j = _entries(state.x.shape[1])
            E = 0.5 * (np.swapaxes(state.F, 1, 2) @ state.F - np.eye(state.x.shape[1]))
            out["strain"] = E[:, i, j]
        if self._stress:
            out["stress"] = np.zeros((len(state.x), *self.shapes["stress"]))
            for bound in self._stress.values():
                out["stress"][bound.members] = bound.each(self._moment(state, inputs, bound.members))[0]
        return out

    def _moment(self, state: State, inputs: Inputs, members: Array) -> Track:
        """Return the record of some particles at one moment."""
        x, v, C, F = (part[members][None] for part in (state.x, state.v, state.C, state.F))
        step = self._built.scene.time.control_step
        design = self._built.assembly.design(inputs)
        return Track(
            x, v, C, F, np.zeros((0, 0)), {}, step, design, terms=inputs.terms, rest=inputs.state.x
        )  # fmt: skip


def _entries(dim: int) -> tuple[Array, Array]:
    """Return rows and columns of a symmetric matrix's numbers: the diagonal, then 01 (02 12)."""
    i, j = np.triu_indices(dim, 1)
    return np.concatenate([np.arange(dim), i]), np.concatenate([np.arange(dim), j])


def groups_of(built: Built) -> dict[str, Array]:
    """Return the particles of every group of every body, by body.group."""
    return {
        f"{body}.{group}": members
        for body in built.particles.names
        for group, members in built.particles.groups(body).items()
    }
