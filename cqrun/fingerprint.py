"""Hashes that identify the engine: its numeric sources, and the libraries that it computes with.

The hash of the kernels names their cache folder, because numba does not notice that a helper in another file has
changed. The hash of the engine covers all sources that can change a number. It guards run directories, because another
engine may give results that are not bit-for-bit identical.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import os
import sys
from importlib import metadata
from pathlib import Path

KERNELS = (
    "numerics",
    "state.py",
    "materials",
    "actuators",
    "forces",
    "boundaries",
    "loads",
    "engine",
)
"""Files and folders of the package with code that numba compiles; a missing one counts as empty."""

NUMERIC = (
    *KERNELS,
    "geometry",
    "design",
    "controllers",
    "observers",
    "objectives",
    "measures",
    "measurements",
    "optimizers",
    "scene",
    "build",
    "plugin",
    "units.py",
    "store/formats",
    "store/recordings.py",
    "store/synthetic.py",
    "running/drift.py",
    "running/finite_differences.py",
    "running/gradient_memory.py",
    "running/extra_fields.py",
    "running/measuring.py",
    "running/passing.py",
    "running/reaction_table.py",
    "running/rest_loss.py",
    "running/rest_table.py",
    "running/side_by_side.py",
    "running/state_loss.py",
    "running/unknowns.py",
    "fitting",
    "learning",
    "jobs/control.py",
    "jobs/gradcheck.py",
    "jobs/rest.py",
    "jobs/simulate.py",
    "jobs/sysid.py",
)
"""Files and folders whose sources can change a number in the results of a run."""

_PLUGIN_MODULES: set[str] = set()
"""Modules outside the package with code for kernels: the plug-in files that this process has loaded."""

LIBRARIES = ("numba", "numpy", "scipy")
CACHE_VARIABLE = "NUMBA_CACHE_DIR"


def library_versions() -> dict[str, str]:
    """Return the installed versions of the libraries that compute, without importing them."""
    return {name: _version(name) for name in LIBRARIES}


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "absent"


def source_hash(package: Path, versions: dict[str, str], entries: tuple[str, ...] = NUMERIC) -> str:
    """Return 12 hex digits over sources below `package` and over library versions."""
    digest = hashlib.sha256()
    for entry in entries:
        path = package / entry
        for source in sorted(path.rglob("*.py")) if path.is_dir() else [path] * path.is_file():
            content = source.read_bytes()
            digest.update(f"{source.relative_to(package).as_posix()}\0{len(content)}\0".encode())
            digest.update(content)
    for name, version in sorted(versions.items()):
        digest.update(f"{name}=={version}\0".encode())
    return digest.hexdigest()[:12]


@functools.cache
def engine_hash() -> str:
    """Return the hash of this engine, 12 hex digits; computed once per process."""
    return source_hash(Path(__file__).parent, library_versions())


@functools.cache
def kernel_hash() -> str:
    """Return the hash of this engine's kernels, 12 hex digits; computed once per process."""
    return source_hash(Path(__file__).parent, library_versions(), KERNELS)


def set_kernel_cache() -> Path:
    """Set numba's cache to a folder for exactly these kernels, in the user's folder for caches, or where they say.

    The folder is named by the hash of the kernels: numba does not notice a change of a helper in another file. Call it
    before numba is imported, or at the latest before any kernel is defined.

    Returns:
        The folder in use, which changes with `add_kernels`; numba makes it when it first writes there.
    """
    given = os.environ.get(CACHE_VARIABLE)
    if given is None or Path(given).name != kernel_hash():  # a child process finds the folder itself
        import platformdirs

        os.environ[CACHE_VARIABLE] = str(Path(given or platformdirs.user_cache_dir("cqrun")) / kernel_hash())
        if "numba" in sys.modules:  # it has read its environment already
            sys.modules["numba"].config.reload_config()
    return Path(os.environ[CACHE_VARIABLE]) / _plugin_folder()


def _plugin_folder() -> str:
    """Return the folder inside the cache for kernels that use plug-in files, or an empty name without such files.

    Numba's index of compiled code names the classes that the code was compiled for, so a process without those files
    could not read it. And numba does not notice a change of a helper in such a file either.
    """
    digest = hashlib.sha256("\0".join(sorted(_PLUGIN_MODULES)).encode()).hexdigest()[:12]
    return f"plugins-{digest}" if _PLUGIN_MODULES else ""


def has_kernels(source: bytes) -> bool:
    """Return whether Python source outside the package may contain kernels: it imports numba or a kernel folder."""
    stems = {entry.removesuffix(".py") for entry in KERNELS}
    for node in ast.walk(ast.parse(source)):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
        if isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{name}" for name in names]
        for name in names:
            parts = name.split(".")
            if parts[0] == "numba" or (parts[0] == "cqrun" and parts[1:2] and parts[1] in stems):
                return True
    return False


def add_kernels(module: str) -> None:
    """Use a separate cache folder from now on, because kernels use a module outside the package.

    The module's name changes with its content.
    """
    _PLUGIN_MODULES.add(module)
    if "cqrun.numerics.compile" in sys.modules:
        sys.modules["cqrun.numerics.compile"].cache_kernels_in(set_kernel_cache())
