"""cqrun: differentiable soft-robot simulation by the material point method.

`cqrun.load(scene)` returns a problem with `.value_and_grad(params)` and `.simulate(params)`, with NumPy arrays in and
out. `cqrun.environment(scene)` returns a Gymnasium environment (extra `rl`). `cqrun.resolution(scene)` runs a scene on
several grids, and extrapolates what it finds. `cqrun.sweep(scene, ["key=1,2"])` runs it at many points.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from cqrun.version import __version__

if TYPE_CHECKING:
    from cqrun.jobs.api import load as load
    from cqrun.jobs.studies.resolution import resolution as resolution
    from cqrun.jobs.studies.sweep import sweep as sweep
    from cqrun.learning.environment import environment as environment

__all__ = ["__version__", "environment", "load", "resolution", "sweep"]


def __getattr__(name: str) -> Any:
    """Import a function when it is first used: the engine takes a second, which `cqrun --help` must not."""
    if name == "load":
        from cqrun.jobs.api import load

        return load
    if name == "environment":
        from cqrun.learning.environment import environment

        return environment
    if name == "resolution":
        from cqrun.jobs.studies.resolution import resolution

        return resolution
    if name == "sweep":
        from cqrun.jobs.studies.sweep import sweep

        return sweep
    raise AttributeError(f"module 'cqrun' has no attribute '{name}'")


def __dir__() -> list[str]:
    """Return the public names, also those that are imported when they are first used."""
    return sorted(__all__)
