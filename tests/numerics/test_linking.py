"""Helpers are linked into the kernels that call them, and become machine code only there."""

from __future__ import annotations

import gc

import numpy as np
import pytest
from little_worlds import needs_jit
from llvmlite import ir
from numba import cfunc, njit, vectorize
from numba.core.compiler_lock import global_compiler_lock
from numba.core.errors import TypingError
from numba.core.registry import CPUDispatcher, cpu_target

from cqrun.numerics.compile import kernel
from cqrun.numerics.linking import Library

pytestmark = needs_jit


@kernel
def halved(x):
    return 0.5 * x


@kernel
def folded_away(x):
    k = 3
    if k * k < 4:  # LLVM finds out that this is false, and leaves the call out
        return halved(x)
    return x


@kernel
def halved_and_one(x):
    return halved(x) + 1.0


@kernel
def both(x):
    return folded_away(x) + halved_and_one(x)


@kernel
def fails_below_zero(x):
    if x < 0.0:
        raise ValueError("below zero")
    return np.sqrt(x)


@kernel
def calls_it(x):
    return fails_below_zero(x) + 1.0


def libraries(compiled) -> list[Library]:
    """Return the libraries of all versions of a dispatcher."""
    return [version.library for version in compiled.overloads.values()]


def test_a_helper_becomes_no_machine_code_of_its_own():
    assert both(4.0) == 7.0
    (helper,) = halved_and_one.helper.overloads.values()
    assert helper.library.is_helper
    assert not helper.library.codegen._engine.is_symbol_defined(helper.fndesc.llvm_func_name)
    (entry,) = libraries(both)
    assert not entry.is_helper


def test_a_helper_that_only_a_later_one_calls_is_linked():
    """LLVM leaves out what nothing calls yet, so callers come first."""
    assert both(2.0) == 4.0


def test_a_helper_can_be_an_entry_too():
    assert both(4.0) == 7.0
    assert halved_and_one(4.0) == 3.0
    assert halved_and_one(np.float32(4.0)) == 3.0
    assert len(libraries(halved_and_one)) == 2


def test_an_error_in_a_helper_reaches_python():
    assert calls_it(4.0) == 3.0
    with pytest.raises(ValueError, match="below zero"):
        calls_it(-1.0)


def test_functions_may_call_each_other():
    @njit
    def even(n):
        return odd(n - 1) if n > 0 else True

    @njit
    def odd(n):
        return even(n - 1) if n > 0 else False

    assert even(10)
    assert not even(7)


def test_numbas_own_ways_to_compile_still_work():
    squared = vectorize(["f8(f8)"])(lambda x: x * x)
    np.testing.assert_array_equal(squared(np.arange(3.0)), [0.0, 1.0, 4.0])
    assert cfunc("f8(f8)")(lambda x: 2.0 * x).ctypes(3.0) == 6.0
    assert njit(lambda x: np.sort(x)[0] + len(str(3)))(np.array([2.0, 1.0])) == 2.0


def test_a_helper_that_is_missing_stops_the_compilation():
    library = Library(cpu_target.target_context.codegen(), "lacks")
    module = library.create_ir_module("lacks")
    missing = ir.Function(module, ir.FunctionType(ir.VoidType(), []), "_ZN6absent")
    lacking = ir.Function(module, ir.FunctionType(ir.VoidType(), []), "lacking")
    builder = ir.IRBuilder(lacking.append_basic_block())
    builder.call(missing, [])
    builder.ret_void()
    library.add_ir_module(module)
    with global_compiler_lock:
        assert library.get_pointer_to_function("absent") == 0
        with pytest.raises(AssertionError, match="_ZN6absent was not linked"):
            library.get_pointer_to_function("lacking")


def test_garbage_is_collected_before_and_after_a_kernel_is_compiled_but_not_meanwhile(monkeypatch):
    collects = []

    @kernel
    def doubled(x):
        return 2.0 * x

    def compile_as_numba(compiled, signature):
        collects.append(gc.isenabled())
        return numbas_own(compiled, signature)

    numbas_own = CPUDispatcher.compile
    monkeypatch.setattr(CPUDispatcher, "compile", compile_as_numba)
    assert gc.isenabled()
    assert doubled(2.0) == 4.0
    assert gc.isenabled()
    with pytest.raises(TypingError):
        doubled("two")
    assert gc.isenabled()
    assert collects == [False, False]
