"""Which engine this is: hashes of the numeric sources and of the libraries that round for them.

The kernels' hash names their cache, because numba does not see that a helper in another file has changed. The
engine's, over all that can change a number, guards run directories, because another need not give the same bits.
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
    "boundaries",
    "loads",
    "engine",
)
"""Files and folders of the package with code that numba compiles; absent ones count as empty."""

NUMERIC = (
    *KERNELS,
    "geometry",
    "design",
    "controllers",
    "observers",
    "objectives",
    "optimizers",
    "scene",
    "build",
    "plugin",
    "units.py",
    "store/alignment.py",
    "store/c3d.py",
    "store/marker_csv.py",
    "store/recorded_trajectory.py",
    "store/recordings.py",
    "store/synthetic.py",
    "running/finite_differences.py",
    "running/gradient_memory.py",
    "running/side_by_side.py",
    "running/state_loss.py",
    "running/unknowns.py",
    "fitting",
    "learning",
    "jobs/control.py",
    "jobs/gradcheck.py",
    "jobs/simulate.py",
    "jobs/sysid.py",
)
"""Files and folders whose sources can change a number of a run."""

_FOREIGN: set[str] = set()
"""Modules outside the package with code for kernels: the plug-in files of this process."""

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
    """Return the hash of this engine, 12 hex digits; read once a process."""
    return source_hash(Path(__file__).parent, library_versions())


@functools.cache
def kernel_hash() -> str:
    """Return the hash of this engine's kernels, 12 hex digits; read once a process."""
    return source_hash(Path(__file__).parent, library_versions(), KERNELS)


def set_kernel_cache() -> Path:
    """Point numba's cache at a folder of these kernels' own, unless the user has set one.

    Call it before numba is imported, and before any kernel is defined at the latest.

    Returns:
        The folder in use, which changes with `add_kernels`; numba makes it when it first writes there.
    """
    if not os.environ.get(CACHE_VARIABLE):
        import platformdirs

        os.environ[CACHE_VARIABLE] = str(Path(platformdirs.user_cache_dir("cqrun")) / kernel_hash())
        if "numba" in sys.modules:  # it has read its environment already
            sys.modules["numba"].config.reload_config()
    return Path(os.environ[CACHE_VARIABLE]) / _foreign_part()


def _foreign_part() -> str:
    """Return the folder inside the cache's for kernels that know of plug-in files, nothing where there are none.

    An index of compiled code names the classes that the code was compiled for: a process without those files could
    not read it. And a helper in such a file is as invisible to numba as any other.
    """
    digest = hashlib.sha256("\0".join(sorted(_FOREIGN)).encode()).hexdigest()[:12]
    return f"plugins-{digest}" if _FOREIGN else ""


def has_kernels(source: bytes) -> bool:
    """Say whether Python source outside the package may hold code for kernels: it imports what they are made of."""
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
    """Keep kernels apart from now on that know of a module outside the package; its name changes with its content."""
    _FOREIGN.add(module)
    if "cqrun.numerics.compile" in sys.modules:
        sys.modules["cqrun.numerics.compile"].cache_kernels_in(set_kernel_cache())
