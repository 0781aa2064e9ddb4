"""`cqrun export RUN`: write the body that a run has designed, to build it or to simulate it elsewhere.

design.csv       one row per particle: body, groups, position, volume, mass, density, all numbers of its material, the
                 strength of each actuator there, and the initial velocity if any particle has one
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
"""Edge of the cells for the surface, in distances between particles."""

EXACT = 1e-3
"""Largest relative difference between the volume in a surface and the particles' volume."""

HALVINGS = 20
"""Largest number of halvings in the search for this surface."""


def export_design(run: Path, out: Path, reporter: Reporter | None = None) -> list[Path]:
    """Write the design of a run, or its best so far, into a directory; return the files.

    Raises:
        UsageError: there is no run, or it has not found anything yet. RunError: the disk is full.
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


def _instead(run: Path) -> str:
    """Return where the motion of a run is, if it has one."""
    motion = run / "trajectory.h5"
    return f"; its motion is in {motion}, which ParaView and h5py read" if motion.is_file() else ""


def designed(run: Path, reporter: Reporter | None = None) -> tuple[Built, dict[str, Array]]:
    """Return the scene of a run, and the values that it found for the unknowns and their followers.

    Raises:
        UsageError: there is no run, it has found nothing, or a file that its scene uses has changed since.
    """
    record, best = read_record(run), run / FILE
    status, job = record["status"], record["job"]
    so_far = status not in FINISHED and job in LEARNED and best.is_file()
    result = None if so_far else read_result(run)
    if not so_far and result is None:
        raise UsageError(f"{run}: has no design yet ({status}); the command that started it continues it")
    scene = scene_in(run)
    if not scene.unknowns:
        raise UsageError(f"{run}: its scene has no `unknowns`: nothing was designed{_instead(run)}")
    if so_far:
        (reporter or Silent()).phase("the run is not finished: its best design so far is exported")
        return build(scene), learned_in(best)
    values = values_in(result)
    if not values:
        raise UsageError(f"{run}: is a run of {job}, which designs nothing: export the run that it replays")
    built = build(scene)
    return built, values_found(scene, built.particles, values)


def table(built: Built, values: Mapping[str, Array]) -> dict[str, Array]:
    """Return columns (N,) of the particles' volume, mass, density, material and actuators, named with their units.

    In 2D, volumes are areas and masses are per metre of depth. If a body has `unit_mass`, volumes are those that its
    particles fill, and a mass is the density times 1.
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
        on = actuator.model.particles >= 0  # and not a point in the world
        columns.setdefault(head, np.full(len(volume), np.nan))[actuator.model.particles[on]] = strength[on]
    if inputs.state.v.any():
        columns |= {f"velocity {axis} [m/s]": v for axis, v in zip("xyz", inputs.state.v.T, strict=False)}
    return columns


def _table(built: Built, x: Array, columns: Mapping[str, Array]) -> Iterator[list[object]]:
    """Yield one row per particle."""
    yield ["body", "groups", *(f"{axis} [m]" for axis in "xyz"[: built.scene.dim]), *columns]
    for body in built.particles.names:
        part = built.particles.of(body)
        groups = built.particles.points[body].groups
        for k in range(part.start, part.stop):
            names = " ".join(name for name, members in groups.items() if members[k - part.start])
            numbers = (None if np.isnan(column[k]) else float(column[k]) for column in columns.values())
            yield [body, names, *x[k].tolist(), *numbers]


# --- surfaces ---------------------------------------------------------------------------------------------------


def _filled(x: Array, volume: Array) -> tuple[Array, Array, float]:
    """Return the fill of the nodes of a grid around a body, its lowest node [m] and the edge of its cells [m]."""
    dim = x.shape[1]
    edge = CELL * float(volume.max()) ** (1.0 / dim)  # if parts differ, the coarsest one decides
    size = x.max(axis=0) - x.min(axis=0)
    resolution = max(1, int(np.ceil(float(size.max()) / edge)))
    edge = float(size.max()) / resolution
    cells = np.maximum(1, np.ceil(size / edge - 1e-9).astype(int))
    share = (field(x, resolution).T @ volume).reshape(cells + 2) / edge**dim
    return np.pad(share, 1), x.min(axis=0) - 1.5 * edge, edge


def _level(enclosed: Callable[[float], float], volume: float, fullest: float) -> float:
    """Return by halving the fill on the surface that encloses a volume; it is less than 0.5 for a thin body."""
    low, high, level = 0.0, fullest, 0.5 * fullest
    for _ in range(HALVINGS):
        level = 0.5 * (low + high)
        inside = enclosed(level)
        if abs(inside - volume) <= EXACT * volume:
            break
        low, high = (level, high) if inside > volume else (low, level)
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
        if mesh.volume < 0.0:  # the normals point inwards
            mesh.invert()
        return mesh

    level = _level(lambda level: float(mesh_at(level).volume), float(np.sum(volume)), float(share.max()))
    write_bytes(path, mesh_at(level).export(file_type="stl"))


def _outline(x: Array, volume: Array, path: Path) -> None:
    """Write the outlines of a 2D body as CSV: number of the closed line, x and y [m]."""
    import contourpy

    share, low, edge = _filled(x, volume)
    contours = contourpy.contour_generator(z=share.T)

    def area(level: float) -> float:
        lines = [edge * np.asarray(line) for line in contours.lines(level)]  # holes have the opposite orientation
        return abs(sum(0.5 * float(np.sum(a[:-1, 0] * a[1:, 1] - a[1:, 0] * a[:-1, 1])) for a in lines))

    level = _level(area, float(np.sum(volume)), float(share.max()))
    lines = enumerate(contours.lines(level))
    rows = ([k, *corner] for k, line in lines for corner in (low + edge * np.asarray(line)).tolist())
    write_table(path, [["line", "x [m]", "y [m]"], *rows])
