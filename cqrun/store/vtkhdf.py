"""The view of a trajectory for ParaView: VTKHDF 2.0, temporal PolyData, one vertex per particle.

Points and fields are virtual datasets over /particles, so that nothing is stored twice. In 2D, z is 0.
https://docs.vtk.org/en/latest/vtk_file_formats/vtkhdf_file_format/vtkhdf_specifications.html
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cqrun.plugin.contract import Array
from cqrun.store.atomic import replacing
from cqrun.store.frames import STANDING

if TYPE_CHECKING:
    import h5py

CELLS = ("Vertices", "Lines", "Polygons", "Strips")


def add_vtk_view(file: h5py.File) -> None:
    """Add /VTKHDF to a packed trajectory with at least one frame."""
    frames, count, _ = file["particles/x"].shape
    group = file.create_group("VTKHDF", track_order=True)
    group.attrs["Version"] = np.array([2, 0], "i8")
    group.attrs.create("Type", np.bytes_("PolyData"))
    _add_view(group, "Points", file["particles/x"])
    group["NumberOfPoints"] = np.array([count], "i8")
    for name in CELLS:
        _add_cells(group.create_group(name), count if name == "Vertices" else 0)
    steps = group.create_group("Steps")
    steps.attrs["NSteps"] = np.int64(frames)
    steps["Values"] = file["time"][()]
    zeros, starts = np.zeros(frames, "i8"), count * np.arange(frames, dtype="i8")
    steps["PartOffsets"] = zeros
    steps["NumberOfParts"] = zeros + 1
    steps["PointOffsets"] = starts
    for name in ("CellOffsets", "ConnectivityIdOffsets"):
        steps[name] = np.zeros((frames, len(CELLS)), "i8")
    data, offsets = group.create_group("PointData"), steps.create_group("PointDataOffsets")
    for name, source in file["particles"].items():
        if name == "x":
            continue
        if name in STANDING:
            data[name] = source  # a hard link: the same for every step
            offsets[name] = zeros
        else:
            _add_view(data, name, source)
            offsets[name] = starts


def write_points(path: Path, x: Array, columns: Mapping[str, Array]) -> None:
    """Write particles at x (N, 2 or 3) with columns of numbers (N,) by name, as PolyData without time steps.

    Raises:
        RunError: the disk is full.
    """
    import h5py

    with replacing(path) as temporary, h5py.File(temporary, "w", libver=("v110", "v110")) as file:
        group = file.create_group("VTKHDF", track_order=True)
        group.attrs["Version"] = np.array([2, 0], "i8")
        group.attrs.create("Type", np.bytes_("PolyData"))
        group["Points"] = np.pad(x, ((0, 0), (0, 3 - x.shape[1])))
        group["NumberOfPoints"] = np.array([len(x)], "i8")
        for name in CELLS:
            _add_cells(group.create_group(name), len(x) if name == "Vertices" else 0)
        data = group.create_group("PointData", track_order=True)
        for name, column in columns.items():
            data[name.replace("/", " per ")] = column  # a slash would create a group


def _add_cells(group: h5py.Group, count: int) -> None:
    group["NumberOfCells"] = np.array([count], "i8")
    group["NumberOfConnectivityIds"] = np.array([count], "i8")
    group["Connectivity"] = np.arange(count, dtype="i8")
    group["Offsets"] = np.arange(count + 1, dtype="i8")


def _add_view(group: h5py.Group, name: str, source: h5py.Dataset) -> None:
    """Add (T, N, ...) as (T N,) or (T N, components); vectors with two components get a third one of 0."""
    import h5py

    frames, count, *suffix = source.shape
    width = int(np.prod(suffix, dtype=int))
    shape: tuple[int, ...] = (frames * count,)
    if suffix:
        shape += (3 if width == 2 else width,)
    space, whole = h5py.h5s.create_simple(shape), h5py.h5s.create_simple(source.shape)
    space.select_hyperslab((0,) * len(shape), (shape[0], width)[: len(shape)])
    layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    layout.set_virtual(space, b".", source.name.encode(), whole)
    layout.set_fill_value(np.zeros((), source.dtype))
    layout.set_obj_track_times(False)  # h5py would store the time, so that equal runs would differ
    kind = h5py.h5t.py_create(source.dtype)
    h5py.h5d.create(group.id, name.encode(), kind, h5py.h5s.create_simple(shape), dcpl=layout)
