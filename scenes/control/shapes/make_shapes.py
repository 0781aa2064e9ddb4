"""Draw rhino.png and creature.stl, the bodies of two scenes: `python scenes/control/shapes/make_shapes.py`.

Both are cqrun's own, and so is this script: CC0, see README.md beside it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

HERE = Path(__file__).parent

WIDTH, HEIGHT = 900, 560
"""Of the rhino's image [pixels]; the scene makes it .5 m wide."""

HIDE = "#8c8c96"
CHAMBERS = {"#d1495b": (150, 220), "#edae49": (220, 290), "#00798c": (520, 590), "#30638e": (590, 660)}
"""Colour of a chamber -> where along the image it begins and ends [pixels]: each leg is two."""

CELL = 0.018
"""Edge of the cells that the creature's surface is found in [m]."""


def rhino() -> Image.Image:
    """Return a rhino that looks to the right, on two legs of two chambers each."""
    image = Image.new("RGB", (WIDTH, HEIGHT), "white")
    pen = ImageDraw.Draw(image)
    outline = [
        (60, 250), (85, 170), (150, 120), (250, 95), (380, 105), (470, 120), (560, 90), (640, 100), (690, 150),
        (740, 140), (752, 110), (768, 150), (800, 175), (815, 180), (850, 90), (868, 200), (890, 240), (880, 290),
        (840, 315), (770, 310), (715, 330), (670, 390), (500, 405), (310, 400), (140, 390), (85, 340),
    ]  # fmt: skip
    pen.polygon(outline, fill=HIDE)
    pen.polygon([(640, 105), (648, 50), (676, 125)], fill=HIDE)  # ear
    pen.polygon([(66, 215), (14, 330), (28, 335), (84, 265)], fill=HIDE)  # tail
    for colour, (left, right) in CHAMBERS.items():
        pen.rectangle([left, 380, right - 1, HEIGHT - 1], fill=colour)
    return image


def capsule(x: np.ndarray, a: list[float], b: list[float], radius: float) -> np.ndarray:
    """Return the signed distance of points (..., 3) from a rounded stick from a to b [m]."""
    start, along = np.array(a), np.subtract(b, a)
    share = np.clip((x - start) @ along / max(along @ along, 1e-12), 0.0, 1.0)
    return np.linalg.norm(x - start - share[..., None] * along, axis=-1) - radius


def joined(one: np.ndarray, other: np.ndarray, blend: float) -> np.ndarray:
    """Return the union of two distances, its edge filled over a length `blend` [m]."""
    gap = np.maximum(blend - np.abs(one - other), 0.0) / blend
    return np.minimum(one, other) - 0.25 * blend * gap**2


def creature(x: np.ndarray) -> np.ndarray:
    """Return the signed distance [m] of points (..., 3): a stout animal on four legs, looking along x, y upward."""
    body = capsule(x, [0.12, 0.15, 0.12], [0.26, 0.155, 0.12], 0.085)
    head = joined(
        capsule(x, [0.34, 0.215, 0.12], [0.35, 0.215, 0.12], 0.06),
        capsule(x, [0.38, 0.195, 0.12], [0.41, 0.19, 0.12], 0.032), 0.03,
    )  # fmt: skip
    tail = capsule(x, [0.06, 0.18, 0.12], [0.0, 0.24, 0.12], 0.026)
    parts = [head, tail]
    parts += [capsule(x, [u, 0.0, w], [u, 0.12, w], 0.042) for u in (0.09, 0.29) for w in (0.055, 0.185)]
    parts += [capsule(x, [0.325, 0.26, w], [0.315, 0.3, 0.5 * w + 0.06], 0.025) for w in (0.08, 0.16)]
    for part in parts:
        body = joined(body, part, 0.03)
    return np.maximum(body, -x[..., 1])  # feet are flat


def surface(cell: float) -> np.ndarray:
    """Return the creature's triangles (n, 3, 3) [m], counterclockwise from outside, by naive surface nets.

    Every cell that the surface passes through has one corner of it, the mean of where its edges are cut; every edge of
    the grid that is cut has a square through the corners of the four cells around it.
    """
    counts = np.ceil(np.array([0.56, 0.42, 0.36]) / cell).astype(int)
    nodes = (np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1) - 4.5) * cell
    distance = creature(nodes)
    total, cuts = np.zeros((*(counts - 1), 3)), np.zeros(counts - 1)
    for axis in range(3):
        u, w = (a for a in range(3) if a != axis)
        low, high = distance.take(range(counts[axis] - 1), axis), distance.take(range(1, counts[axis]), axis)
        cut = (low < 0) != (high < 0)
        share = np.where(cut, low / np.where(cut, low - high, 1.0), 0.0)
        place = nodes.take(range(counts[axis] - 1), axis) + cell * share[..., None] * np.eye(3)[axis]
        for i in (0, 1):
            for j in (0, 1):
                part = [slice(None)] * 3
                part[u], part[w] = slice(i, counts[u] - 1 + i), slice(j, counts[w] - 1 + j)
                total += np.where(cut[tuple(part)][..., None], place[tuple(part)], 0.0)
                cuts += cut[tuple(part)]
    corner = total / np.maximum(cuts, 1)[..., None]
    triangles = []
    for axis in range(3):
        u, w = (axis + 1) % 3, (axis + 2) % 3
        step_u, step_w = np.eye(3, dtype=int)[u], np.eye(3, dtype=int)[w]
        low, high = distance.take(range(counts[axis] - 1), axis), distance.take(range(1, counts[axis]), axis)
        edges = np.argwhere((low < 0) != (high < 0))
        square = [corner[tuple((edges - a * step_u - b * step_w).T)] for a, b in ((1, 1), (0, 1), (0, 0), (1, 0))]
        inward = (high < 0)[tuple(edges.T)]
        for p, q, r in ((0, 1, 2), (0, 2, 3)):
            found = np.stack([square[p], square[q], square[r]], axis=1)
            triangles.append(np.where(inward[:, None, None], found[:, ::-1], found))
    return np.concatenate(triangles)


def write_stl(path: Path, triangles: np.ndarray) -> None:
    """Write triangles (n, 3, 3) as binary STL."""
    record = np.zeros(len(triangles), np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")]))
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    record["normal"], record["corners"] = normal / np.where(length > 0, length, 1.0), triangles
    path.write_bytes(b"cqrun creature, CC0".ljust(80) + np.uint32(len(record)).tobytes() + record.tobytes())


if __name__ == "__main__":
    rhino().quantize(16).save(HERE / "rhino.png", optimize=True)
    write_stl(HERE / "creature.stl", surface(CELL))
