"""What is told while kernels are compiled."""

from __future__ import annotations

from little_worlds import needs_jit
from numba import njit

from cqrun.running.kernels import FUNCTIONS, _told
from cqrun.running.reporter import Silent


class Listener(Silent):
    """A reporter that keeps what it is told."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[tuple[int, int, str]] = []

    def advance(self, done: int, total: int, text: str) -> None:
        self.told.append((done, total, text))


@needs_jit
def test_the_kernel_and_the_number_of_its_functions_are_told():
    inner = njit(lambda x: x + 1.0, no_cpython_wrapper=True)  # as kernels call each other

    @njit
    def outer(x):
        return 2.0 * inner(x)

    reporter = Listener()
    with _told(reporter, adjoint=False):
        assert outer(1.0) == 4.0
        assert outer(2.0) == 6.0  # compiled already
    total = FUNCTIONS[False]
    assert reporter.told == [
        (1, total, f"outer: function 1 of about {total}"),
        (1, total, "outer: optimising all of it"),
        (2, total, f"outer: function 2 of about {total}"),
    ]
    assert outer(1) == 4  # a new type, after the listener has gone
    assert len(reporter.told) == 3
