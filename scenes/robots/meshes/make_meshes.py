"""Make the meshes of the scenes of robots, in millimetres: `python scenes/robots/meshes/make_meshes.py`.

All are cqrun's own, and so is this script: CC0, see README.md beside it. A body is a union of boxes without a union of
others. The planes of all their faces divide space into cells, and the surface consists of the faces between full and
empty cells. So it is closed, whatever the boxes are.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent

Box = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
"""The lower and the upper end of a box along x, y and z [mm]."""


def pneunet(
    chambers: int = 7,
    length: float = 100.0,
    width: float = 20.0,
    height: float = 20.0,
    wall: float = 2.0,
    layer: float = 3.0,
    gap: float = 2.0,
    channel: tuple[float, float] = (4.0, 2.0),
    root: float = 4.0,
) -> tuple[list[Box], list[Box]]:
    """Return the boxes of a bending actuator, and those of its cavity, along x, its limiting layer at z = 0.

    Args:
        chambers: number of chambers, each in a block of its own; a channel joins them to one cavity.
        length, width, height: of the whole along x, y and z [mm].
        wall: thickness of the walls of chambers, and of the roof of the channel [mm].
        layer: thickness of the bottom below chambers and channel [mm].
        gap: between blocks [mm].
        channel: its width and height [mm].
        root: solid part before the first block, which can be clamped [mm].
    """
    block = (length - root - gap * (chambers - 1)) / chambers
    roof = layer + channel[1] + wall
    solid: list[Box] = [((0, length), (0, width), (0, roof)), ((0, root), (0, width), (0, height))]
    cavity: list[Box] = []
    for k in range(chambers):
        begin = root + k * (block + gap)
        end = begin + block
        solid.append(((begin, end), (0, width), (0, height)))
        cavity.append(((begin + wall, end - wall), (wall, width - wall), (layer, height - wall)))
    middle = 0.5 * (width - channel[0]), 0.5 * (width + channel[0])
    cavity.append(((root + wall, length - wall), middle, (layer, layer + channel[1])))
    return solid, cavity


def surface(solid: Sequence[Box], cavity: Sequence[Box]) -> np.ndarray:
    """Return the triangles (n, 3, 3) [mm] of boxes without others, counterclockwise seen from outside."""
    boxes = np.round(np.array([*solid, *cavity], float), 6)  # so that equal planes are one
    planes = [np.unique(boxes[:, axis]) for axis in range(3)]
    full = np.zeros([len(ends) + 1 for ends in planes], bool)  # with an empty cell before and after
    for number, box in enumerate(boxes):
        low, high = (tuple(np.searchsorted(planes[a], box[a, side]) for a in range(3)) for side in (0, 1))
        full[tuple(slice(begin + 1, end + 1) for begin, end in zip(low, high, strict=True))] = number < len(solid)
    triangles = []
    for axis in range(3):
        u, w = (axis + 1) % 3, (axis + 2) % 3
        low, high = full.take(range(full.shape[axis] - 1), axis), full.take(range(1, full.shape[axis]), axis)
        face = np.argwhere(low != high)
        corners = []
        for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)):
            x = np.zeros((len(face), 3))
            x[:, axis], x[:, u], x[:, w] = (
                planes[axis][face[:, axis]], planes[u][face[:, u] - 1 + i], planes[w][face[:, w] - 1 + j],
            )  # fmt: skip
            corners.append(x)
        outward = low[tuple(face.T)][:, None, None]
        for p, q, r in ((0, 1, 2), (0, 2, 3)):
            found = np.stack([corners[p], corners[q], corners[r]], axis=1)
            triangles.append(np.where(outward, found, found[:, ::-1]))
    return np.concatenate(triangles)


def write_stl(path: Path, triangles: np.ndarray) -> None:
    """Write triangles (n, 3, 3) as binary STL."""
    record = np.zeros(len(triangles), np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")]))
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    record["normal"], record["corners"] = normal / np.linalg.norm(normal, axis=1, keepdims=True), triangles
    path.write_bytes(f"cqrun {path.stem}, CC0".encode().ljust(80) + np.uint32(len(record)).tobytes() + record.tobytes())


if __name__ == "__main__":
    write_stl(HERE / "pneunet.stl", surface(*pneunet()))
