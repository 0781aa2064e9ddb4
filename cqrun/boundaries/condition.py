"""Boundary conditions: projections of the velocity of grid nodes.

The grid pass gets a condition as a `NamedTuple` of its own class with one `coefficient` and the unit `normal`, which
points into the free side: a tuple of D numbers, or for terrain one normal per node (`NodeNormals`). The class selects
the functions, which get the normal of one node:

    project(condition, v)                -> v of the node after the boundary
    project_vjp(condition, v, out_bar)   -> v_bar, coefficient_bar

At a kink they take the branch of H(x) = [x >= 0], as CQ1 does.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, ClassVar, NamedTuple, Self

import numpy as np
from numba.core import types
from numba.extending import overload
from pydantic import Field, model_validator

from cqrun.numerics.compile import named, own_symbols, written
from cqrun.numerics.dispatch import ByClass
from cqrun.plugin.choice import Choice, Chosen
from cqrun.plugin.contract import Array, Plugin, quantity, vector
from cqrun.plugin.reference import Face

FACES = ("x_min", "x_max", "y_min", "y_max", "z_min", "z_max")

_PROJECT = ByClass("project", "condition, v")
_PROJECT_VJP = ByClass("project_vjp", "condition, v, out_bar")
project, project_vjp = _PROJECT.call, _PROJECT_VJP.call


class NodeNormals(NamedTuple):
    """A unit normal for every node; the length of `dims` is the dimension."""

    table: Array  # (nodes, D)
    dims: tuple[int, ...]


own_symbols(NodeNormals)

Normal = tuple[float, ...] | Array
"""A unit normal for all nodes, or one for each (nodes, D)."""


class BoundaryCondition(Plugin):
    """A condition on grid nodes: on faces of the world, or in a region."""

    needs_normal: ClassVar[bool] = True
    is_obstacle: ClassVar[bool] = False
    """Whether bodies of the reference frame touch it; else it holds the nodes that it has at rest."""

    face: Face | None = Field(description="Face of the world, or all faces", default=None)
    region: Annotated[Chosen[Plugin], Choice("region")] | None = Field(
        description="Region whose nodes it applies to", default=None
    )
    normal: list[float] | None = vector("1", "Unit normal into the free side, for a region", default=None)
    thickness: float = quantity("m", "Depth of the condition, from the face into the world", ge=0, default=0.0)

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        if (self.face is None) == (self.region is None):
            raise ValueError("give exactly one of `face` and `region`")
        if self.face is not None and self.normal is not None:
            raise ValueError("`normal` belongs to a region; a face has its own")
        if self.region is not None and self.thickness > 0:
            raise ValueError("`thickness` belongs to a face; a region has its own size")
        if self.lacks_normal and not getattr(self.region.value, "is_name", False):  # the scene checks a name's region
            raise ValueError(self.lack)
        if self.normal is not None and not np.isclose(np.linalg.norm(self.normal), 1.0, atol=1e-6):
            raise ValueError("`normal` must have length 1")
        return self

    @property
    def lacks_normal(self) -> bool:
        """Whether it needs a normal and its region has none."""
        return self.region is not None and self.needs_normal and self._region_normal() is None

    @property
    def lack(self) -> str:
        """The error message for a missing normal."""
        return f"a region other than half_space and height_field needs `normal`, a unit vector, for {self.name}"

    def _region_normal(self) -> Any:
        if self.normal is not None:
            return self.normal
        # the normal of a half-space points out of its solid side; terrain has a normal for every node
        region = self.region.value if self.region is not None else None
        return getattr(region, "normal", None) or getattr(region, "normals", None)

    def kernel_condition(self, normal: Any) -> Any:
        """Return the kernel's view for a unit normal or `NodeNormals`."""
        raise NotImplementedError

    def places(self, nodes: Array, size: Array) -> list[tuple[Array, Normal]]:
        """Return (nodes (n,) as bool, unit normal) for every plane of this condition.

        Args:
            nodes: node positions (n, D) [m].
            size: size of the world (D,) [m].
        """
        dim = len(size)
        if self.region is not None:
            normal = self._region_normal() or [0.0] * dim
            inside: Any = self.region.value
            if callable(normal):
                return [(inside.inside(nodes), normal(nodes))]
            return [(inside.inside(nodes), tuple(float(a) for a in normal))]
        faces = FACES[: 2 * dim] if self.face == "all" else (self.face,)
        return [self._face(str(face), nodes, size) for face in faces]

    def _face(self, face: str, nodes: Array, size: Array) -> tuple[Array, tuple[float, ...]]:
        axis, sign = "xyz".index(face[0]), 1.0 if face.endswith("min") else -1.0
        depth = nodes[:, axis] if sign > 0 else size[axis] - nodes[:, axis]
        normal = [0.0] * len(size)
        normal[axis] = sign
        return depth <= self.thickness + 1e-9 * size[axis], tuple(normal)


def register(kernel_class: type, project_: Callable[..., Any], project_vjp_: Callable[..., Any]) -> None:
    """Register the functions of a kernel class."""
    _PROJECT.register(kernel_class, project_)
    _PROJECT_VJP.register(kernel_class, project_vjp_)


# --- all conditions of a node: bit k of `bits` is set if condition k applies to it --------------------------


def at_node(condition: Any, node: int) -> Any:
    """Return a condition with its normal at a node."""
    normal = condition.normal
    if not isinstance(normal, NodeNormals):
        return condition
    return type(condition)(tuple(float(a) for a in normal.table[node]), condition.coefficient)


@overload(at_node)
def _at_node(condition, node):
    normal = condition.types[condition.fields.index("normal")]
    if isinstance(normal, types.NamedTuple | types.NamedUniTuple) and normal.instance_class is NodeNormals:
        kind, dim = condition.instance_class, len(normal.types[normal.fields.index("dims")])
        entries = ", ".join(f"condition.normal.table[node, {k}]" for k in range(dim))
        body = written(f"lambda condition, node: kind(({entries}), condition.coefficient)", {"kind": kind})
        return named(body, f"{kind.__name__}_at_node_{dim}")
    return lambda condition, node: condition


def project_all(conditions: Any, node: int, bits: int, v: Any) -> Any:
    """Return a node's velocity after its conditions, in order."""
    for k, condition in enumerate(conditions):
        if (bits >> k) & 1:
            v = project(at_node(condition, node), v)
    return v


def project_all_vjp(
    conditions: Any, node: int, bits: int, v: Any, out_bar: Any, coefficient_bar: Array, first: int
) -> Any:
    """Return v_bar, and add to coefficient_bar[first + k] for condition k."""
    if not conditions:
        return out_bar
    if not bits & 1:
        return project_all_vjp(conditions[1:], node, bits >> 1, v, out_bar, coefficient_bar, first + 1)
    condition = at_node(conditions[0], node)
    after = project(condition, v)
    after_bar = project_all_vjp(conditions[1:], node, bits >> 1, after, out_bar, coefficient_bar, first + 1)
    v_bar, c_bar = project_vjp(condition, v, after_bar)
    coefficient_bar[first] += c_bar
    return v_bar


@overload(project_all)
def _project_all(conditions, node, bits, v):
    if len(conditions) == 0:
        return lambda conditions, node, bits, v: v

    def several(conditions, node, bits, v):
        if bits & 1:
            v = project(at_node(conditions[0], node), v)
        return project_all(conditions[1:], node, bits >> 1, v)

    return several


@overload(project_all_vjp)
def _project_all_vjp(conditions, node, bits, v, out_bar, coefficient_bar, first):
    if len(conditions) == 0:
        return lambda conditions, node, bits, v, out_bar, coefficient_bar, first: out_bar

    def several(conditions, node, bits, v, out_bar, coefficient_bar, first):
        rest, more = conditions[1:], bits >> 1
        if bits & 1:
            condition = at_node(conditions[0], node)
            after = project(condition, v)
            after_bar = project_all_vjp(rest, node, more, after, out_bar, coefficient_bar, first + 1)
            v_bar, c_bar = project_vjp(condition, v, after_bar)
            coefficient_bar[first] += c_bar
            return v_bar
        return project_all_vjp(rest, node, more, v, out_bar, coefficient_bar, first + 1)

    return several
