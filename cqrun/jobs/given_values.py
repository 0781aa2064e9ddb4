"""The values that a user gives to a problem by key path: completed, checked, and their gradient in the same form."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from cqrun.build.model import Built
from cqrun.build.substep import stable
from cqrun.design.params import Block, Params
from cqrun.errors import SceneError, UsageError
from cqrun.explain import listed, shown, suggest
from cqrun.learning.agent import CONTROLLER
from cqrun.plugin.contract import Array
from cqrun.scene.paths import canonical, leaf, leaves, require_possible
from cqrun.scene.unknowns import body_of, groups_of

Values = Mapping[str, Any]
"""Key path -> number, or an array with one number per group or particle of the body; `controller.<block>` -> array.

Values that follow an unknown (`also`) follow it here too, unless they are given; a single number applies to all.
"""


class GivenValues:
    """What a user may give for one scene.

    Args:
        built: the scene.
        params: the unknowns and the controller's parameters, with their start values.
        auto: whether the number of substeps is chosen for the scene's own values.
    """

    def __init__(self, built: Built, params: Params, auto: bool) -> None:
        self.built, self._params, self._auto = built, params, auto

    def stable(self, params: Values | None) -> dict[str, Array]:
        """Return all values; raise UsageError if they are not stable with the substep that `auto` has chosen.

        A number of substeps that the scene gives is not checked: unsuitable values blow up.
        """
        values = self._values(params)
        if params and self._auto:
            require_stable(self.built, {p: v for p, v in values.items() if not p.startswith(CONTROLLER)})
        return values

    def _values(self, params: Values | None) -> dict[str, Array]:
        if not isinstance(params, Mapping | None):
            raise UsageError(f"params must be a mapping from key paths to values, is {shown(params)}")
        given: dict[str, Array] = {}
        for path, value in (params or {}).items():
            full = self._full_path(path)
            given[full] = self._shaped(full, numbers_of(path, value))
        self._require_legal(given)
        values = {b.path: b.initial.copy() for b in self._params.blocks} | given
        for block in self._params.blocks:
            for follower in block.followers:
                if follower.path not in given:
                    values[block.path] = _followed(block, values[block.path])
                    values[follower.path] = follower.of(values[block.path])
        return values

    def _require_legal(self, given: Mapping[str, Array]) -> None:
        """Raise UsageError for values that the scene refuses; check the smallest and largest number of arrays."""
        of_scene = {path: value for path, value in given.items() if not path.startswith(CONTROLLER)}
        for end in (np.min, np.max) if any(value.ndim for value in of_scene.values()) else (np.min,):
            try:
                require_possible(self.built.scene, {path: float(end(value)) for path, value in of_scene.items()})
            except SceneError as error:
                raise UsageError("; ".join(f"{p.path}: {p.message}" for p in error.problems)) from None

    def with_followers(self, gradient: dict[str, Array], params: Values | None) -> dict[str, Any]:
        """Return the gradient with the parts of followers added to their unknowns, unless a follower was given."""
        given = {self._full_path(path) for path in params or {}}
        for block in self._params.blocks:
            for follower in block.followers:
                if follower.path not in given:
                    gradient[block.path] = gradient[block.path] + follower.of_vjp(gradient.pop(follower.path))
        return {path: plain(bar) for path, bar in gradient.items()}

    def _full_path(self, path: str) -> str:
        """Return the long form of a path that gradients reach."""
        if not isinstance(path, str):
            raise UsageError(f"params: a key path is text, such as 'world.gravity.1', not {shown(path)}")
        if path.startswith(CONTROLLER):
            blocks = [b.path for b in self._params.blocks if b.path.startswith(CONTROLLER)]
            if path in blocks:
                return path
            raise UsageError(f"{path}: no block of the controller{suggest(path, blocks)}; there are: {listed(blocks)}")
        reached = list(leaves(self.built.scene, differentiable=True))
        try:
            if leaf(self.built.scene, path).differentiable:
                return canonical(self.built.scene, path)
        except SceneError as error:
            raise UsageError(f"{path}: {error.problems[0].message}") from None
        raise UsageError(f"{path}: no gradient reaches it{suggest(path, reached)}; there are: {listed(reached)}")

    def _shaped(self, path: str, value: Array) -> Array:
        """Check a value: its shape is a block's, (), or for materials and weights one number per group or particle."""
        keys = path.split(".")
        legal: list[tuple[int, ...]] = [()]
        if path.startswith(CONTROLLER):
            legal = [b.initial.shape for b in self._params.blocks if b.path == path]
        elif (keys[0] == "bodies" and keys[2] == "material") or (keys[0] == "actuators" and keys[-1] == "weight"):
            part, groups = (
                self.built.particles.of(body_of(self.built.scene, path)),
                len(groups_of(self.built.scene, path)),
            )
            legal += [(part.stop - part.start,), *[(groups,)] * (groups > 0)]
        if value.shape not in legal:
            raise UsageError(f"{path}: a value of shape {value.shape}; it must be one of {listed(map(str, legal))}")
        if not np.isfinite(value).all():
            raise UsageError(f"{path}: must be finite, is {value}")
        return value


def require_stable(built: Built, values: dict[str, Array]) -> None:
    """Raise UsageError if values by path are not stable with the substep of a scene."""
    try:
        least, needed = stable(built.scene, built.particles, built.assembly, values)
    except SceneError as error:
        raise UsageError("; ".join(f"{p.path}: {p.message}" for p in error.problems)) from None
    if built.model.dt > least.dt:
        raise UsageError(
            f"{least.part}: with these values the largest stable substep is {least.dt:.3g} s, but `auto` has "
            f"chosen {built.model.dt:.3g} s for the scene: load it with time.substeps={needed}, or make what "
            "changes an unknown with bounds that contain these values"
        )


def _followed(block: Block, value: Array) -> Array:
    """Return the value of an unknown with followers in its full shape; a single number applies to all entries."""
    if value.shape not in ((), block.initial.shape):
        some = f" or of shape {block.initial.shape}" if block.initial.ndim else ""
        others = listed(follower.path for follower in block.followers)
        raise UsageError(
            f"{block.path}: a value of shape {value.shape}; it must be a number{some}, for {others} to follow"
        )
    return np.array(np.broadcast_to(value, block.initial.shape))


def numbers_of(path: str, value: Any) -> Array:
    try:
        return np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise UsageError(f"{path}: must be a number or an array of numbers, is {shown(value)}") from None


def plain(value: Array) -> Any:
    """Return a 0-dimensional array as a number, another as a copy."""
    return float(value) if np.ndim(value) == 0 else np.array(value)
