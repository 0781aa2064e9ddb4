"""cqrun from Python: a scene as a function, NumPy in and out.

    problem = cqrun.load("scenes/sysid/beam_twin.yaml", ["time.duration=0.3"])
    loss, gradient, aux = problem.value_and_grad({"loads.air.damping.rate": 2.0})
    motion = problem.simulate()
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.contract import Array
from cqrun.engine.rollout import Rollout
from cqrun.errors import SceneError, UsageError
from cqrun.explain import listed, suggest
from cqrun.jobs.cases import given_cases, make_cases
from cqrun.jobs.problem import FitProblem, make_params
from cqrun.jobs.runs import cores
from cqrun.scene.build import Built, build
from cqrun.scene.load import load_scene
from cqrun.scene.paths import canonical, leaf, leaves
from cqrun.scene.plugin_files import plugins_allowed
from cqrun.scene.schema import Scene
from cqrun.state import State

Values = Mapping[str, Any]
"""Key path -> number, or an array with one number a group or a particle of the body."""


@dataclass(frozen=True)
class Motion:
    """What a simulation did.

    Attributes:
        time: of the control steps 0 .. T (T + 1,) [s].
        x: positions (T + 1, N, D) [m].
        v: velocities (T + 1, N, D) [m/s].
        bodies: each body's slice of the N particles.
    """

    time: Array
    x: Array
    v: Array
    bodies: dict[str, slice]


class Experiment:
    """A scene as a function of its numbers.

    Args:
        scene: validated.
        threads: how many to use; all cores if not given. Results do not depend on it.

    Attributes:
        built: the scene's particles and model.
        params: its unknowns at their starts, by key path; arrays where there is one number a group or particle.
    """

    def __init__(self, scene: Scene, threads: int | None = None) -> None:
        self.built: Built = build(scene)
        self.threads = cores(threads)
        self._params = make_params(self.built)
        self.params: dict[str, Any] = {b.path: _plain(b.initial) for b in self._params.blocks}

    @property
    def scene(self) -> Scene:
        """The resolved scene."""
        return self.built.scene

    def value_and_grad(self, params: Values | None = None) -> tuple[float, dict[str, Any], dict[str, Any]]:
        """Return the loss of the scene's data, its gradient, and what else is known.

        Args:
            params: values by key path: of any numbers that gradients reach, not of the unknowns alone. Unknowns
                that are left out keep their start; bounds are not enforced.

        Returns:
            The loss; its derivative by every unknown and every number in `params`, of the shape of its value; and
            {"losses": part of the loss by recording or sequence, "gradient": {"recompute_factor", "peak_bytes"}}.

        Raises:
            UsageError: a path or a shape that cannot be, or a scene without data.
            RolloutError: the scene blows up.
        """
        if self.scene.data is None:
            raise UsageError("this scene has no `data`, so there is no loss: add some, or use simulate()")
        problem, values = self._problem, self._values(params)
        losses, gradient = problem.losses_and_gradient(values)
        effort = {"recompute_factor": problem.effort.recompute, "peak_bytes": problem.effort.peak}
        aux = {"losses": losses, "gradient": effort}
        return float(sum(losses.values())), {path: _plain(bar) for path, bar in gradient.items()}, aux

    def simulate(self, params: Values | None = None) -> Motion:
        """Run the scene forward with values by key path; arguments and errors as `value_and_grad`."""
        n_controls, step = self.built.model.n_controls, self.scene.time.control_step
        n, dim = self.built.particles.x.shape
        x, v = np.zeros((n_controls + 1, n, dim)), np.zeros((n_controls + 1, n, dim))

        def keep(control: int, state: State) -> None:
            x[control], v[control] = state.x, state.v

        inputs = self.built.assembly.inputs(self._values(params))
        Rollout(self.built.model, inputs, threads=self.threads).run(keep)
        particles = self.built.particles
        bodies = {name: particles.of(name) for name in particles.names}
        return Motion(np.arange(n_controls + 1) * step, x, v, bodies)

    @cached_property
    def _problem(self) -> FitProblem:
        return FitProblem(given_cases(self.built) or make_cases(self.built), self._params, threads=self.threads)

    def _values(self, params: Values | None) -> dict[str, Array]:
        values = {b.path: b.initial.copy() for b in self._params.blocks}
        for path, value in (params or {}).items():
            known = self._known(path)
            values[known] = self._shaped(known, np.array(value, dtype=float))
        return values

    def _known(self, path: str) -> str:
        """Return the long spelling of a path that gradients reach."""
        reached = list(leaves(self.scene, differentiable=True))
        try:
            if leaf(self.scene, path).differentiable:
                return canonical(self.scene, path)
        except SceneError as error:
            raise UsageError(str(error.problems[0].message)) from None
        raise UsageError(f"{path}: no gradient reaches it{suggest(path, reached)}; there are: {listed(reached)}")

    def _shaped(self, path: str, value: Array) -> Array:
        """Return a value of a legal shape: () or, for a body's material, one a group or a particle."""
        keys = path.split(".")
        legal: list[tuple[int, ...]] = [()]
        if keys[0] == "bodies" and keys[2] == "material":
            part = self.built.particles.of(keys[1])
            groups = len(self.scene.bodies[keys[1]].group_names)
            legal += [(part.stop - part.start,), *[(groups,)] * (groups > 0)]
        if value.shape not in legal:
            raise UsageError(f"{path}: a value of shape {value.shape}; it must be one of {listed(map(str, legal))}")
        if not np.isfinite(value).all():
            raise UsageError(f"{path}: must be finite, is {value}")
        return value


def _plain(value: Array) -> Any:
    """Return a number for an array of no dimension, else a copy of the array."""
    return float(value) if np.ndim(value) == 0 else np.array(value)


def load(
    scene: Path | str | dict[str, Any],
    overrides: Sequence[str] = (),
    *,
    threads: int | None = None,
    allow_plugins: bool = False,
) -> Experiment:
    """Return a scene as a function.

    Args:
        scene: a file's path, YAML text (with a line break), or plain data.
        overrides: `key.path=value` each, as `-o` of the command line.
        threads: how many to use; all cores if not given.
        allow_plugins: whether the Python files that the scene names as its plug-ins may be run.

    Raises:
        SceneError: every problem of the scene, each with its place.
    """
    with plugins_allowed(allow_plugins):
        return Experiment(load_scene(scene, overrides), threads)
