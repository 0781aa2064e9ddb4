"""How functions become machine code: a helper is lowered once, and optimised only in the kernels that it is part of.

Numba compiles each function that another one calls as if Python called it: with wrappers, through all passes of LLVM,
and to machine code. The caller then gets the optimised function, inlines it, and optimises it again with itself. So a
function that lies five calls deep is optimised six times, and five of its six machine codes are never run. Here a
function has two forms:

    entry     Python calls it: it has a wrapper, whose address Numba asks for, and so becomes machine code.
    helper    other functions call it: its LLVM code is linked into the entry, with that of all helpers that it calls.

An entry is optimised once, with everything that it calls.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from llvmlite import binding
from numba.core import codegen, event
from numba.core.environment import lookup_environment
from numba.core.registry import CPUDispatcher
from numba.core.runtime import rtsys

OPTIMISING = "cqrun:optimising"
"""The event of an entry that LLVM works on: its functions are there, and are optimised together."""

ENVIRONMENT = "_ZN08NumbaEnv"
"""How the name of the pointer to a function's Python objects begins."""

OF_ONE_BODY: set[str] = set()
"""Functions that are never inlined, as their names occur in symbols; see `one_body`."""


class Library(codegen.JITCodeLibrary):
    """Compiled code that calls its own copies of helpers, never those of another kernel.

    Numba puts a weak copy of a helper into every kernel that calls it, and the run-time linker binds all calls to the
    copy that it loads first. Each copy is optimised in its own surroundings, so copies fuse different additions and
    products. The last bits of a result would then depend on the order in which kernels were compiled or loaded.
    """

    is_helper = False

    def finalize(self) -> None:
        """Keep the functions as they are: they become machine code if the address of one is asked for."""
        self._raise_if_finalized()
        if any(is_of_one_body(function.name) for function in self.get_own_functions()):
            self._optimize_alone()
        self._finalize_dynamic_globals()
        self._finalized = self.is_helper = True

    def get_own_functions(self) -> list[Any]:
        """Return the functions of LLVM that this library defines."""
        return [function for function in self._final_module.functions if not function.is_declaration]

    def get_pointer_to_function(self, name: str) -> int:
        """Return the address of a function, or 0 if there is none: helpers have no wrapper, which Numba asks for."""
        self._ensure_finalized()
        if self.is_helper and any(function.name == name for function in self.get_own_functions()):
            self._make_code()
        return super().get_pointer_to_function(name)

    def _make_code(self) -> None:
        """Optimise the functions with all helpers that they call, and make machine code of them."""
        if any(v.name.startswith(codegen.RuntimeLinker.PREFIX) for v in self._final_module.global_variables):
            # functions that call each other: Numba asks for this address while the code is made, which is too late
            rtsys.library.get_pointer_to_function("nrt_unresolved_abort")
        self.is_helper = self._finalized = False
        self._linking_libraries = self._closure()
        with event.trigger_event(OPTIMISING):
            super().finalize()
        for name in environments(self._final_module):
            self._codegen.set_env(name, lookup_environment(name))

    def _optimize_alone(self) -> None:
        """Optimise a helper of one body with those that it calls, so that it is the same in all entries."""
        for library in self._closure():
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._linking_libraries = []
        self._optimize_final_module()

    def _closure(self) -> list[Library]:
        """Return all libraries that this one calls, directly or not: callers before those that they call.

        LLVM leaves a helper out that nothing calls at the moment when it is linked.
        """
        order: list[Library] = []
        seen: set[int] = set()

        def visit(library: Library) -> None:
            if id(library) not in seen:
                seen.add(id(library))
                for called in library._linking_libraries if library.is_helper else ():
                    visit(called)
                order.append(library)

        for library in self._linking_libraries:
            visit(library)
        return order[::-1]

    def _optimize_final_module(self) -> None:
        """Optimise an entry with its helpers, which are its own: `internal`."""
        for function in self._final_module.functions:
            if not function.is_declaration and function.linkage == binding.Linkage.linkonce_odr:
                function.linkage = "internal"
                if is_of_one_body(function.name):
                    function.add_function_attribute("noinline")
        super()._optimize_final_module()

    def _verify_declare_only_symbols(self) -> None:
        """Stop if a helper is missing: calling it would end the process."""
        for function in self._final_module.functions:
            if function.is_declaration and function.name.startswith("_ZN"):
                raise AssertionError(f"{self.name}: {function.name} was not linked")


def is_of_one_body(symbol: str) -> bool:
    """Return whether a symbol is that of a function of one body."""
    return any(name in symbol for name in OF_ONE_BODY)


def environments(module: Any) -> list[str]:
    """Return the names of the environments of a module's functions that exist in this process."""
    names = [variable.name for variable in module.global_variables if variable.name.startswith(ENVIRONMENT)]
    return [name for name in names if lookup_environment(name) is not None]


def _set_env(self: Any, name: str, environment: Any) -> None:
    if self._engine.is_symbol_defined(name):
        _numba_set_env(self, name, environment)


_numba_set_env = codegen.JITCPUCodegen.set_env
codegen.JITCPUCodegen.set_env = _set_env
codegen.JITCPUCodegen._library_class = Library


@contextmanager
def garbage_kept() -> Iterator[None]:
    """Collect no garbage: little of what a compiler makes is garbage, and to look for it takes a tenth of the time."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


class Kernel(CPUDispatcher):
    """A function that Python calls as an entry, and other functions as a helper."""

    helper: CPUDispatcher

    def compile(self, sig: Any) -> Any:
        """Compile the entry of a signature, with its helpers."""
        with garbage_kept():
            return super().compile(sig)

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Return how a function that is being compiled calls this one."""
        return self.helper.get_call_template(args, kws)

    def get_overload(self, sig: Any) -> Any:
        """Return the helper of a signature."""
        return self.helper.get_overload(sig)
