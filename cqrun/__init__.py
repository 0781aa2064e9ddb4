"""cqrun: differentiable soft-robot simulation by the material point method.

cqrun.load(scene) gives a problem with `.value_and_grad(params)` and `.simulate(params)`, NumPy in and out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from cqrun.fingerprint import set_kernel_cache

if TYPE_CHECKING:
    from cqrun.jobs.api import load as load

__version__ = "0.1.0"
__all__ = ["__version__", "load"]

set_kernel_cache()  # here, because numba reads its cache folder when it is first imported


def __getattr__(name: str) -> Any:
    """Import `load` when it is first asked for: the engine takes a second, `cqrun --help` must not."""
    if name == "load":
        from cqrun.jobs.api import load

        return load
    raise AttributeError(f"module 'cqrun' has no attribute '{name}'")
