"""Functions that kernels select by the class of their first argument.

Kernels get the numbers of a plug-in as a `NamedTuple` of its own class. The class selects the plug-in's function at
compile time, so the choice costs nothing at run time.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba.extending import overload, register_jitable

from cqrun.numerics.compile import named, own_symbols


class ByClass:
    """A function with a body for each class of its first argument.

    Args:
        name: name of the function.
        arguments: its arguments, such as "condition, v".

    Attributes:
        call: the function, for kernels and for Python.
        bodies: by class, the body and its arguments.
    """

    def __init__(self, name: str, arguments: str) -> None:
        self.name, self.arguments = name, arguments
        self.bodies: dict[type, tuple[Callable[..., Any], str]] = {}
        scope: dict[str, Any] = {"python": self._python, "compiled": self._compiled}
        first = arguments.partition(",")[0]
        exec(f"def {name}({arguments}):\n    return python({first})({arguments})", scope)
        exec(f"def choose({arguments}):\n    return compiled({first})", scope)
        self.call: Callable[..., Any] = scope[name]
        overload(self.call)(scope["choose"])

    def register(self, kernel_class: type, body: Callable[..., Any], arguments: str | None = None) -> None:
        """Set the body for a class; `arguments` are those of the body, if it takes fewer."""
        own_symbols(kernel_class)
        self.bodies[kernel_class] = body, arguments or self.arguments

    def __contains__(self, kernel_class: type) -> bool:
        """Return whether a class has a body."""
        return kernel_class in self.bodies

    def _wrapped(self, kernel_class: type, body: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function of all arguments that calls a body with those that it takes."""
        source = f"lambda {self.arguments}: body({self.bodies[kernel_class][1]})"
        return named(eval(source, {"body": body}), f"{self.name}_{kernel_class.__name__}")

    def _python(self, first: Any) -> Callable[..., Any]:
        return self._wrapped(type(first), self.bodies[type(first)][0])

    def _compiled(self, first: Any) -> Callable[..., Any]:
        body = self.bodies[first.instance_class][0]
        return self._wrapped(first.instance_class, body if hasattr(body, "py_func") else register_jitable(body))
