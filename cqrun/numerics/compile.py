"""Compilation of kernels, and the barrier of the threads that run them.

Every thread runs the same compiled loop over substeps and computes its share of each pass; between passes the threads
wait at a barrier, which counts arrivals. Compared with `prange` this compiles several times faster, allows nested
tuples as arguments, costs nothing on one thread, and yields the core while it waits (an OpenMP barrier spins, which on
a shared machine is ten times slower). Results are bit-for-bit identical for any number of threads.

`fastmath` is only `contract` (fused multiply-add): `nnan` and `ninf` would delete the checks for non-finite numbers.
`error_model="numpy"` raises no hidden exception; an exception in one thread would leave the others waiting.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from llvmlite import ir
from numba import config
from numba.core import caching, extending, types
from numba.core.registry import CPUDispatcher
from numba.extending import intrinsic, overload

from cqrun.numerics.linking import OF_ONE_BODY, Kernel

extending._overload_default_jit_options["no_cfunc_wrapper"] = True

_OPTIONS = {"nopython": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract"}, "no_cfunc_wrapper": True}
_KERNELS: list[Any] = []


CACHE_PROBLEMS: dict[str, bool] = {}
"""What the cache could not do in this process, as sentences, and whether compiled code was lost."""


class SharedIndex(caching.IndexDataCacheFile):
    """A kernel's index of compiled versions, which only one process at a time changes.

    Numba reads the index, takes the next free number for a file and writes both. Without a lock, two processes that
    compile different versions at the same time take the same number, and one of them later loads the other's code.

    A file that is damaged, or cannot be written, costs time only: the code is compiled again.
    """

    def save(self, key: Any, data: Any) -> None:
        """Add a version under its key."""
        try:
            with Path(f"{self._index_path}.lock").open("wb") as lock:
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX)
                except OSError:
                    self._note(
                        "this file system has no locks, so nothing keeps two processes apart that compile at once: let "
                        "one end first, or set NUMBA_CACHE_DIR to a folder on a local disk"
                    )
                super().save(key, data)
        except OSError as error:
            self._note(
                f"compiled kernels cannot be kept here ({error.strerror}), so the next process compiles them again; "
                "set NUMBA_CACHE_DIR to another folder",
                lost=True,
            )

    def load(self, key: Any) -> Any:
        """Return the version of a key, or None."""
        try:
            return super().load(key)
        except Exception:  # an incomplete file, as after a power cut, may raise anything
            return None

    def _load_index(self) -> Any:
        try:
            return super()._load_index()
        except Exception:  # a damaged index may raise anything; without one, kernels are compiled again
            return {}

    def _note(self, problem: str, lost: bool = False) -> None:
        CACHE_PROBLEMS[f"{Path(self._index_path).parent.parent}: {problem}"] = lost


caching.IndexDataCacheFile = SharedIndex


PACKAGE = Path(__file__).absolute().parents[1]


def _folder_in_cache(cls: type, file: str) -> str:
    """Return the folder of a source file's kernels: for the package its own folder's name, the same for all copies.

    The cache's folder is named by the hash of the sources, so copies of the package, such as clones and environments,
    share what one of them has compiled. Elsewhere it is named as Numba does, also if the file's path is not UTF-8.
    """
    folder = Path(file).absolute().parent
    if folder.is_relative_to(PACKAGE):
        return "_".join(("cqrun", *folder.relative_to(PACKAGE).parts))
    return f"{folder.name}_{hashlib.sha1(os.fsencode(folder)).hexdigest()}"


caching._CacheLocator.get_suitable_cache_subpath = classmethod(_folder_in_cache)


def kernel(function: Callable[..., Any]) -> Any:
    """Compile a function of the engine at its first call, or load it from the cache (decorator).

    Kernels do not count references to the arrays of their arguments; Numba would count them for every node and lane.
    """
    return _kernel(function, references=False)


def allocating_kernel(function: Callable[..., Any]) -> Any:
    """Compile like `kernel` a function that allocates arrays; it must not return them."""
    return _kernel(function, references=True)


def one_body(function: Callable[..., Any]) -> Any:
    """Compile like `kernel` a function whose results must be bit-for-bit identical for all its callers.

    It is never inlined, because inlined copies would be optimised in different ways.
    """
    OF_ONE_BODY.add(f"{len(function.__name__)}{function.__name__}")  # its form in mangled names
    return kernel(function)


def _kernel(function: Callable[..., Any], references: bool) -> Any:
    if config.DISABLE_JIT:
        return function
    options = {**_OPTIONS, "_nrt": references}
    compiled = Kernel(function, targetoptions=options)
    compiled.helper = CPUDispatcher(function, targetoptions={**options, "no_cpython_wrapper": True})
    _KERNELS.append(compiled)
    _cache(compiled)
    return compiled


def _cache(compiled: Any) -> None:
    """Keep the versions of a kernel, unless no folder for them can be written."""
    try:
        compiled.enable_caching()
    except RuntimeError:
        CACHE_PROBLEMS[
            f"{config.CACHE_DIR}: no folder for compiled kernels can be written, so every process compiles them again; "
            "set NUMBA_CACHE_DIR to one that can"
        ] = True


def cache_kernels_in(folder: Path) -> None:
    """Store compiled code in this folder from now on, also that of kernels that are already defined."""
    config.CACHE_DIR = str(folder)
    for compiled in _KERNELS:
        _cache(compiled)


def own_symbols(kernel_class: type) -> None:
    """Give a NamedTuple in the arguments of kernels a unique name.

    Numba distinguishes classes when it compiles, but names the compiled functions by `__name__` only: two classes
    called `Kernel` would share their symbols, and the linker would give one the other's code.
    """
    kernel_class.__name__ = f"{kernel_class.__module__}.{kernel_class.__qualname__}".replace(".", "_")


def named(function: Callable[..., Any], name: str) -> Callable[..., Any]:
    """Give a function that is made at run time a unique name, for the reason given in `own_symbols`."""
    function.__name__ = function.__qualname__ = name
    return function


def written(source: str, scope: dict[str, Any] | None = None) -> Callable[..., Any]:
    """Return the function of a lambda's source, with a name made from the source."""
    digest = hashlib.sha256(source.encode()).hexdigest()[:12]
    return named(eval(source, scope or {}), f"written_{digest}")


def for_each(call: Callable[..., None]) -> Callable[..., None]:
    """Return a function of (items, ...) that runs call(item, ...) for every item of a tuple of any types."""

    def run(items: Any, *others: Any) -> None:
        for item in items:
            call(item, *others)

    name = f"{call.__name__}_of_each"

    @overload(run)
    def _run(items, *others):
        if len(items) == 0:
            return named(lambda items, *others: None, f"no_{name}")

        def several(items, *others):
            call(items[0], *others)
            run(items[1:], *others)

        return named(several, name)

    return run


def for_one(call: Callable[..., Any], otherwise: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of (items, ...) that returns call(item, ...) for the one item, or otherwise(...) for none."""

    def run(items: Any, *others: Any) -> Any:
        return call(items[0], *others) if items else otherwise(*others)

    name = call.__name__

    @overload(run)
    def _run(items, *others):
        if len(items) == 0:
            return named(lambda items, *others: otherwise(*others), f"without_{name}")
        return named(lambda items, *others: call(items[0], *others), f"with_{name}")

    return run


class Pass(NamedTuple):
    """One pass of a list: its name, its function, and the function's arguments: expressions of those of the list.

    A `tiled` pass may run tile by tile with another one, which then does its work.
    """

    name: str
    run: Callable[..., None]
    arguments: str
    tiled: bool = False


def in_order(name: str, arguments: str, passes: Sequence[Pass]) -> Callable[..., None]:
    """Return the function of `arguments` that runs all passes in order, for kernels and for Python."""
    scope: dict[str, Any] = {f"pass_{k}": each.run for k, each in enumerate(passes)}
    calls = "".join(f"    pass_{k}({each.arguments})\n" for k, each in enumerate(passes))
    exec(f"def {name}({arguments}):\n{calls}", scope)
    exec(f"def {name}_in_kernels({arguments}):\n{calls}", scope)
    exec(f"def choose({arguments}):\n    return {name}_in_kernels", scope)
    overload(scope[name])(scope["choose"])
    return scope[name]


LOOKS = 10_000
"""How often a thread checks the barrier before it yields its core."""


def _cell(context: Any, builder: Any, array_type: Any, array: Any, k: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [k])


@intrinsic
def _atomic_add(typingctx: Any, a: Any, k: Any, value: Any) -> Any:
    """Add to an entry and return its old value."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = _cell(context, builder, a, args[0], args[1])
        return builder.atomic_rmw("add", pointer, args[2], "seq_cst")

    return types.int64(a, types.intp, types.int64), codegen


@intrinsic
def _atomic_load(typingctx: Any, a: Any, k: Any) -> Any:
    """Return the current value of an entry; unlike an addition, this does not move its cache line."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load_atomic(_cell(context, builder, a, args[0], args[1]), "acquire", 8)

    return types.int64(a, types.intp), codegen


@intrinsic
def _pause(typingctx: Any) -> Any:
    """Yield the core to another thread."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = ir.FunctionType(ir.IntType(32), [])
        function = builder.module.globals.get("sched_yield")
        if function is None:
            function = ir.Function(builder.module, kind, "sched_yield")
        builder.call(function, [])
        return context.get_dummy_value()

    return types.none(), codegen


def barrier(arrivals: Any, n_threads: int) -> None:
    """Wait until all threads have arrived, or one is marked as missing.

    Args:
        arrivals: number of arrivals at all barriers so far, and whether a thread is missing; int64 (2,), shared.
    """


@overload(barrier)
def _barrier(arrivals, n_threads):
    def wait(arrivals, n_threads):
        if n_threads > 1:
            before = _atomic_add(arrivals, 0, 1)
            complete = (before // n_threads + 1) * n_threads
            looks = 0
            while _atomic_load(arrivals, 0) < complete:
                looks += 1
                if looks > LOOKS:
                    if _atomic_load(arrivals, 1) != 0:
                        break
                    _pause()

    return wait


@kernel
def share(n: int, thread: int, n_threads: int) -> tuple[int, int]:
    """Return one thread's range of 0 .. n."""
    return n * thread // n_threads, n * (thread + 1) // n_threads
