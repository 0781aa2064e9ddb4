"""Make the scene of each grid of a resolution study, and find what differs between the grids for other reasons.

Particles and substeps follow the grid. A body with `particles_per_cell` does so by itself; `spacing` is scaled, and so
is a `count` of particles. A number of substeps is scaled, too, so that a substep stays the same part of a cell.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from itertools import groupby, pairwise
from math import ceil

import numpy as np

from cqrun.build.check_grid import nearest_nodes
from cqrun.build.check_holds import reached_nodes
from cqrun.build.model import Built
from cqrun.engine.reference.held import held_at
from cqrun.errors import UsageError
from cqrun.explain import listed
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import body_of
from cqrun.running.tables import number
from cqrun.scene.body import Body
from cqrun.scene.schema import Scene
from cqrun.scene.walk import parts
from cqrun.store.thinnest import Thinnest

AUTO, RATIO = "auto", 1.5
"""`auto` is the scene's grid, and one with cells 1.5 times smaller."""

FEWEST, MOST = 2, 3

CLOSE = 1.1
"""Grids must differ by this factor: the closer they are, the more extrapolation multiplies what else differs."""

MASS, MOVED, SIZE = 0.005, 0.1, 0.05
"""Reported differences between grids: of a body's mass relative to it, of a region's centre in cells, of its volume."""

WHOLE = 1e-6
"""Numbers that differ by this part of them are the same."""

SIMPLE, ROUNDED = 4, 2e-3
"""A cell size is a rounded fraction of the scene's with a denominator up to 4, if it differs by this part at most."""


def grids_of(text: str, scene: Scene) -> tuple[float, ...]:
    """Return the cell sizes of an option `--resolution`, finest last [m]: `auto`, or two or three numbers.

    Raises:
        UsageError: they are not two or three numbers that become clearly smaller.
    """
    dx = scene.world.dx
    if text == AUTO:
        return dx, dx / RATIO
    example = f"--resolution {number(dx)},{number(dx / RATIO)}"
    try:
        cells = tuple(_exact(float(cell), dx) for cell in text.split(","))
    except ValueError:
        message = f"--resolution {text}: give two or three cell sizes in m, such as {example}; or none, {example}"
        raise UsageError(message) from None
    if not FEWEST <= len(cells) <= MOST:
        raise UsageError(f"--resolution {text}: names {len(cells)}; two or three grids are compared, such as {example}")
    if not all(0 < cell < float("inf") for cell in cells):
        raise UsageError(f"--resolution {text}: cell sizes are positive numbers, such as {example}")
    for coarse, fine in pairwise(cells):
        if coarse < CLOSE * fine:
            same = "are the same grid" if coarse == fine else "are too close" if coarse > fine else "become coarser"
            raise UsageError(
                f"--resolution {text}: {number(coarse)} and {number(fine)} m {same}: give the finest grid last, and "
                f"each at least {CLOSE:g} times finer than the one before, such as {example}"
            )
    return cells


def _exact(cell: float, dx: float) -> float:
    """Return a cell size, or the simple fraction of the scene's that it rounds: 0.00667 m is 2/3 of 0.01 m.

    Then nodes of both grids meet at the faces of clamps, and whole numbers of particles fit into the same bodies.
    """
    if not 0 < cell < float("inf"):
        return cell
    fraction = Fraction(cell / dx).limit_denominator(SIMPLE)
    exact = dx * fraction.numerator / fraction.denominator
    return exact if abs(exact - cell) < ROUNDED * cell else cell


def require_cells(cells: float, thinnest: Mapping[str, Thinnest]) -> None:
    """Raise UsageError for a grid that is coarser than a body."""
    for name, part in thinnest.items():
        if part.cells < 1 - WHOLE:
            raise UsageError(
                f"--resolution: cells of {number(cells)} m are coarser than the body '{name}', whose thinnest part is "
                f"{number(part.thickness)} m: a result with less than a cell across it shows nothing; start with at "
                f"most {number(part.thickness)} m"
            )


# --- the scene of a grid ----------------------------------------------------------------------------------------------


def grid_overrides(scene: Scene, cells: float) -> list[str]:
    """Return the overrides that give a scene cells of another size [m], and particles and substeps that fit them.

    Raises:
        UsageError: a number of particles would not be whole.
    """
    factor = scene.world.dx / cells
    if abs(factor - 1) < WHOLE:
        return []
    overrides = [f"world.dx={cells!r}"]
    for name, body in scene.bodies.items():
        overrides += _particles(name, body, cells, factor)
    if isinstance(scene.time.substeps, int):
        overrides.append(f"time.substeps={ceil(scene.time.substeps * factor * (1 - WHOLE))}")
    return overrides


def _particles(name: str, body: Body, cells: float, factor: float) -> Iterator[str]:
    """Yield overrides for the particles of a body."""
    if body.unit_mass:
        raise UsageError(
            f"--resolution: every particle of '{name}' has the same mass on every grid (`unit_mass`), so a finer grid "
            "makes it heavier: remove unit_mass, and give its density in kg/m^3"
        )
    if body.spacing is not None:
        yield f"bodies.{name}.spacing={body.spacing / factor!r}"
    sampling, path = body.sampling, f"bodies.{name}.sampling.{body.sampling.name}.count"
    if sampling.value.needs_spacing:
        return
    count = getattr(sampling.value, "count", None)
    if count is None:
        raise UsageError(
            f"--resolution: the particles of '{name}' do not follow the grid, because its sampling "
            f"'{sampling.name}' has neither a spacing nor a count: give it `particles_per_cell`"
        )
    wanted = count * factor if sampling.name == "lattice" else count * factor ** len(body.velocity)
    if sampling.name == "lattice" and abs(wanted - round(wanted)) > WHOLE * wanted:
        raise UsageError(
            f"--resolution: {path} is {count}, which would have to become {wanted:.4g} with cells of "
            f"{number(cells)} m: choose grids with which it stays whole, or give the body "
            "`particles_per_cell` instead of a count"
        )
    yield f"{path}={round(wanted)}"


def changes(scene: Scene, cells: float, overrides: Sequence[str]) -> Iterator[str]:
    """Yield sentences on what else is changed with a grid."""
    for override in overrides:
        key, _, value = override.partition("=")
        if key == "time.substeps":
            yield (
                f"time.substeps is {scene.time.substeps} in the scene, and {value} with cells of {number(cells)} m: a "
                "substep stays the same part of a cell"
            )
        elif key != "world.dx":
            yield f"{key} is {value} with cells of {number(cells)} m: particles follow the grid"


# --- what else differs ------------------------------------------------------------------------------------------------


def differences(grids: Sequence[Built]) -> Iterator[str]:
    """Yield sentences on bodies and regions that differ between grids by more than the grid itself."""
    first, *others = grids
    unit = "kg" if first.scene.dim == 3 else "kg/m"
    for name in first.particles.names:
        masses = [_mass(built, name) for built in grids]
        if max(masses) > (1 + MASS) * min(masses):
            shown = listed([f"{number(m)} {unit}" for m in masses])
            yield (
                f"the mass of '{name}' is {shown} on the grids: its edges are not whole numbers of particles; take "
                "grids of which they are"
            )
    found = [dict(_regions(built)) for built in grids]
    for path, (x, volume) in found[0].items():
        for built, regions in zip(others, found[1:], strict=True):
            if sentence := _differs(path, (x, volume), regions.get(path, (x[:0], volume[:0])), first, built):
                yield sentence
    for path, nodes in _held(first).items():
        for built in others:
            yield from _moved_edge(path, nodes, _held(built)[path], first, built)


def _mass(built: Built, name: str) -> float:
    return float(built.assembly.inputs({}).fields.mass[built.particles.of(name)].sum())


def _regions(built: Built) -> Iterator[tuple[str, tuple[Array, Array]]]:
    """Yield the positions and volumes of the particles in every group, and in every region of a part, by path."""
    particles = built.particles
    for body in particles.names:
        for group, members in particles.groups(body).items():
            yield f"bodies.{body}.groups.{group}", (particles.x[members], particles.volume[members])
    for loc, part in parts(built.scene):
        region = getattr(part, "region", None)
        if region is not None and loc[0] in ("loads", "actuators", "objective", "constraints"):
            members = particles.inside(body_of(part), region)
            yield ".".join(map(str, (*loc, "region"))), (particles.x[members], particles.volume[members])


def _differs(
    path: str, coarse: tuple[Array, Array], fine: tuple[Array, Array], first: Built, other: Built
) -> str | None:
    """Return a sentence on a region that holds other particles on another grid; None if it is the same region."""
    (x, volume), (y, other_volume) = coarse, fine
    here, there = number(first.scene.world.dx), number(other.scene.world.dx)
    if len(x) == 0 or len(y) == 0:  # a region without particles is refused before
        return None
    ratio = float(other_volume.sum() / volume.sum())
    moved = float(np.linalg.norm(np.average(y, axis=0, weights=other_volume) - np.average(x, axis=0, weights=volume)))
    told = []
    if abs(ratio - 1) > SIZE:
        told.append(f"{100 * abs(ratio - 1):.0f} % {'more' if ratio > 1 else 'less'} volume")
    if moved > MOVED * first.scene.world.dx:
        told.append(f"a centre {number(moved)} m away")
    if not told:
        return None
    return (
        f"{path} holds {len(x)} particles with cells of {here} m, and {len(y)} with cells of {there} m, with "
        f"{listed(told)}: part of the change between the grids comes from that"
    )


def _held(built: Built) -> dict[str, tuple[Array, int]]:
    """Return the nodes that each boundary with a region holds among the bodies' own (n, D) [m], and its particles.

    In the reference frame a body's grid lies on the faces of its clamps, and its nodes are counted, not its particles.
    """
    if built.scene.world.frame == "reference":
        return dict(_held_at_rest(built))
    near = nearest_nodes(built.particles.x, built.model.grid_shape, built.model.dx)
    held = {}
    for condition in built.model.conditions:
        if condition.spec.region is not None:
            nodes = condition.nodes[near]
            x = np.round(built.particles.x[nodes] / built.model.dx) * built.model.dx
            held[f"boundaries.{condition.name}"] = x, int(nodes.sum())
    return held


def _held_at_rest(built: Built) -> Iterator[tuple[str, tuple[Array, int]]]:
    """Yield what each boundary of the reference frame holds, in all its planes, by its path."""
    reached = reached_nodes(built.scene, built.particles).X
    holds = [c for c in built.model.conditions if c.spec.region is not None and not c.spec.is_obstacle]
    for name, planes in groupby(holds, key=lambda condition: condition.name):
        x = reached[held_at(list(planes), reached, np.array(built.scene.world.size)).bits != 0]
        yield f"boundaries.{name}", (x, len(x))


def _moved_edge(
    path: str, coarse: tuple[Array, int], fine: tuple[Array, int], first: Built, other: Built
) -> Iterator[str]:
    """Yield a sentence if a boundary holds a body on one grid alone, or up to another place."""
    (x, count), (y, other_count) = coarse, fine
    here, there = number(first.scene.world.dx), number(other.scene.world.dx)
    if (count == 0) != (other_count == 0):
        filled, empty, particles = (here, there, count) if count else (there, here, other_count)
        yield (
            f"{path} holds {particles} particles with cells of {filled} m, and none with cells of {empty} m: let its "
            "region reach farther into the body"
        )
    elif count and (moved := _moved_inside(first, x, y)) > MOVED * first.scene.world.dx:
        yield (
            f"{path} holds nodes up to {number(moved)} m farther on one grid than on the other (cells of {here} and "
            f"{there} m): put its faces on nodes of both grids, or the free length of a body changes with the grid"
        )


def _moved_inside(built: Built, held: Array, others: Array) -> float:
    """Return how far the ends of held nodes (n, D) differ between two grids [m], without ends where bodies end."""
    x, dx = built.particles.x, built.scene.world.dx
    ends = np.array([held.min(axis=0), held.max(axis=0)])
    moved = np.abs(ends - np.array([others.min(axis=0), others.max(axis=0)]))
    inside = (x.min(axis=0) + dx < ends) & (ends < x.max(axis=0) - dx)
    return float(np.max(moved, where=inside, initial=0.0))
