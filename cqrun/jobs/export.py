"""`cqrun export RUN --design`: the body that a run has designed, for those who will build or simulate it elsewhere.

design.csv       a row a particle: body, groups, position, volume, mass, density and every number of its material, how
                 strong each actuator is there, and the velocity that it starts with if any does
design.vtkhdf    the same for ParaView
surface_BODY.stl the surface of a 3D body (marching cubes, extra `mesh`); in 2D outline_BODY.csv: its outlines
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.build.model import Built, build
from cqrun.design.spread import field
from cqrun.errors import MissingExtra, UsageError
from cqrun.learning.agent import FILE
from cqrun.learning.replay import learned_in
from cqrun.plugin.contract import Array
from cqrun.running.reporter import Reporter, Silent
from cqrun.running.runs import scene_in
from cqrun.running.unknowns import values_found
from cqrun.scene.paths import leaf
from cqrun.store.atomic import make_directory, write_bytes, write_table
from cqrun.store.result import LEARNED, read_result, values_in
from cqrun.store.run import FINISHED, read_record
from cqrun.store.vtkhdf import write_points

CELL = 2.0
"""Edge of the cells that a surface is found on, in distances between particles."""

EXACT = 1e-3
"""Relative difference between what a surface encloses and the particles' volume."""

HALVINGS = 20
"""At most, in search of that surface."""


def export_design(run: Path, out: Path, reporter: Reporter | None = None) -> list[Path]:
    """Write the design of a run into a directory, of one that is not finished the best so far; return the files.

    Raises:
        UsageError: it is no run, or has not found anything yet. RunError: the disk is full.
    """
    built, values = designed(run, reporter)
    make_directory(out)
    columns, written = table(built, values), [out / "design.csv", out / "design.vtkhdf"]
    inputs = built.assembly.inputs(values)
    write_table(written[0], _table(built, inputs.state.x, columns))
    write_points(written[1], inputs.state.x, columns)
    for name in built.particles.names:
        part = built.particles.of(name)
        x, volume = inputs.state.x[part], (inputs.fields.volume * built.particles.room)[part]
        flat = built.scene.dim == 2
        file = out / (f"outline_{name}.csv" if flat else f"surface_{name}.stl")
        (_outline if flat else _surface)(x, volume, file)
        written.append(file)
    return written


def designed(run: Path, reporter: Reporter | None = None) -> tuple[Built, dict[str, Array]]:
    """Return the scene of a run, and the values that were found for its unknowns and what follows them.

    Raises:
        UsageError: it is no run, has found nothing, or a file that its scene is read with has changed since.
    """
    record, best = read_record(run), run / FILE
    status, job = record["status"], record["job"]
    so_far = status not in FINISHED and job in LEARNED and best.is_file()
    result = None if so_far else read_result(run)
    if not so_far and result is None:
        raise UsageError(f"{run}: has no design yet ({status}); the command that began it goes on with it")
    scene = scene_in(run)
    if not scene.unknowns:
        raise UsageError(f"{run}: its scene has no `unknowns`: nothing was designed")
    if so_far:
        (reporter or Silent()).phase("the run is not finished: its best design so far is exported")
        return build(scene), learned_in(best)
    found = values_in(result)
    if not found:
        raise UsageError(f"{run}: is a run of {job}, which designs nothing: export the run that it replays")
    built = build(scene)
    return built, values_found(scene, built.particles, found)


def table(built: Built, values: Mapping[str, Array]) -> dict[str, Array]:
    """Return columns (N,) of the particles' volume, mass, density, material and actuators, named with their units.

    A 2D body is a slice: its volumes are areas, its masses those of a metre of depth. Where a body has `unit_mass`,
    volumes are what its particles fill, and a mass is the density times 1.
    """
    inputs, flat = built.assembly.inputs(values), built.scene.dim == 2
    volume, mass = inputs.fields.volume * built.particles.room, inputs.fields.mass
    names = ("area [m^2]", "mass [kg/m]") if flat else ("volume [m^3]", "mass [kg]")
    columns = {names[0]: volume, names[1]: mass}
    for body in built.particles.names:
        part = built.particles.of(body)
        for path, numbers in built.assembly.material(body, values).items():
            name = path.split(".material.")[1].replace("elastic.", "")
            head = f"{name} [{leaf(built.scene, path).unit}]"
            columns.setdefault(head, np.full(len(volume), np.nan))[part] = numbers
    for actuator, strength in built.assembly.actuation.on_particles(values):
        unit = leaf(built.scene, f"{actuator.path}.{actuator.spec.scale}").unit
        head = f"{actuator.model.name} {actuator.spec.scale} [{unit}]"
        columns.setdefault(head, np.full(len(volume), np.nan))[actuator.model.particles] = strength
    if inputs.state.v.any():
        columns |= {f"velocity {axis} [m/s]": v for axis, v in zip("xyz", inputs.state.v.T, strict=False)}
    return columns


def _table(built: Built, x: Array, columns: Mapping[str, Array]) -> Iterator[list[object]]:
    """Yield a row a particle."""
    yield ["body", "groups", *(f"{axis} [m]" for axis in "xyz"[: built.scene.dim]), *columns]
    for body in built.particles.names:
        part = built.particles.of(body)
        groups = built.particles.points[body].groups
        for k in range(part.start, part.stop):
            own = " ".join(name for name, held in groups.items() if held[k - part.start])
            numbers = (None if np.isnan(column[k]) else float(column[k]) for column in columns.values())
            yield [body, own, *x[k].tolist(), *numbers]


# --- surfaces ---------------------------------------------------------------------------------------------------


def _filled(x: Array, volume: Array) -> tuple[Array, Array, float]:
    """Return how full nodes of a grid around a body are, its lowest node [m] and the grid's edge [m]."""
    dim = x.shape[1]
    edge = CELL * float(volume.max()) ** (1.0 / dim)  # parts may differ: no cell is emptier than the coarsest
    size = x.max(axis=0) - x.min(axis=0)
    resolution = max(1, int(np.ceil(float(size.max()) / edge)))
    edge = float(size.max()) / resolution
    cells = np.maximum(1, np.ceil(size / edge - 1e-9).astype(int))
    share = (field(x, resolution).T @ volume).reshape(cells + 2) / edge**dim
    return np.pad(share, 1), x.min(axis=0) - 1.5 * edge, edge


def _level(enclosed: Callable[[float], float], volume: float, fullest: float) -> float:
    """Return how full nodes are on the surface that encloses a volume, by halving: of a thin body less than half."""
    low, high, level = 0.0, fullest, 0.5 * fullest
    for _ in range(HALVINGS):
        level = 0.5 * (low + high)
        found = enclosed(level)
        if abs(found - volume) <= EXACT * volume:
            break
        low, high = (level, high) if found > volume else (low, level)
    return level


def _surface(x: Array, volume: Array, path: Path) -> None:
    """Write the surface of a 3D body as STL [m]."""
    try:
        import igl
        import trimesh
    except ModuleNotFoundError as error:
        raise MissingExtra(f"a surface needs {error.name}, which is not installed: pip install 'cqrun[mesh]'") from None
    share, low, edge = _filled(x, volume)
    nodes = low + edge * np.stack(np.meshgrid(*map(np.arange, share.shape), indexing="ij"), axis=-1)
    points = np.ascontiguousarray(nodes.transpose(2, 1, 0, 3).reshape(-1, 3))
    filled = np.ascontiguousarray(share.transpose(2, 1, 0).reshape(-1))

    def mesh_at(level: float) -> Any:
        vertices, faces, _ = igl.marching_cubes(filled, points, *share.shape, level)
        mesh = trimesh.Trimesh(vertices, faces)
        if mesh.volume < 0.0:  # faces look inwards, those of cavities outwards
            mesh.invert()
        return mesh

    level = _level(lambda level: float(mesh_at(level).volume), float(np.sum(volume)), float(share.max()))
    write_bytes(path, mesh_at(level).export(file_type="stl"))


def _outline(x: Array, volume: Array, path: Path) -> None:
    """Write the outlines of a 2D body as CSV: number of the closed line, x, y [m]."""
    import contourpy

    share, low, edge = _filled(x, volume)
    contours = contourpy.contour_generator(z=share.T)

    def area(level: float) -> float:
        lines = [edge * np.asarray(line) for line in contours.lines(level)]  # holes run the other way round
        return abs(sum(0.5 * float(np.sum(a[:-1, 0] * a[1:, 1] - a[1:, 0] * a[:-1, 1])) for a in lines))

    level = _level(area, float(np.sum(volume)), float(share.max()))
    lines = enumerate(contours.lines(level))
    rows = ([k, *corner] for k, line in lines for corner in (low + edge * np.asarray(line)).tolist())
    write_table(path, [["line", "x [m]", "y [m]"], *rows])
