"""Recordings as text, as camera systems and other programs export them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

NAMES = ("arm:tip", "base")


def positions(frames: int = 4) -> np.ndarray:
    """Return positions (T, 2, 3) [mm] with a gap: no two numbers are the same, and none is rounded by writing it."""
    x = 0.25 * np.arange(6.0 * frames).reshape(frames, 2, 3) - 2.0
    x[1, 0] = np.nan
    return x


def row(*cells: object) -> list[str]:
    """Return the cells of a line: numbers exactly, and NaN as an empty cell."""
    return ["" if isinstance(cell, float) and np.isnan(cell) else str(cell) for cell in cells]


def table(rows: Sequence[Sequence[str]], separator: str) -> str:
    """Return lines whose cells are separated."""
    return "".join(separator.join(cells) + "\n" for cells in rows)


def wide(x: np.ndarray, names: Sequence[str] = NAMES, rate: float = 100.0, separator: str = ",") -> str:
    """Return a wide table [mm]."""
    head = [f"{name} [mm] {axis}" for name in names for axis in "xyz"[: x.shape[2]]]
    return table([["time", *head], *(row(k / rate, *frame.ravel().tolist()) for k, frame in enumerate(x))], separator)


def long(x: np.ndarray, names: Sequence[str] = NAMES, rate: float = 100.0, separator: str = ",") -> str:
    """Return a long table."""
    head = ["time", "marker", *"xyz"[: x.shape[2]]]
    lines = [
        row(k / rate, name, *frame[m].tolist()) for k, frame in enumerate(x) for m, name in enumerate(names)
    ]  # fmt: skip
    return table([head, *lines], separator)


def motive(x: np.ndarray, names: Sequence[str] = NAMES, rate: float = 100.0, *, words: bool = True) -> str:
    """Return a CSV file of Motive with a rigid body, its expected marker, and sizes of markers; older without words."""
    body = [("Rigid Body", "clamp", role, axis) for role, axes in (("Rotation", "XYZW"), ("Position", "XYZ"))
            for axis in axes] + [("Rigid Body", "clamp", "Mean Marker Error", "")]  # fmt: skip
    expected = [("Rigid Body Marker", names[0], "Position", axis) for axis in "XYZ"]
    markers = [("Marker", name, *each) for name in names
               for each in (("Position", "X"), ("Position", "Y"), ("Position", "Z"), ("Size", ""))]  # fmt: skip
    columns = [*body, *expected, *markers]
    claims = {
        "Format Version": "1.23",
        "Take Name": "beam",
        "Capture Frame Rate": "50",
        "Export Frame Rate": f"{rate:f}",
        "Total Exported Frames": str(len(x)),
        "Length Units": "Millimeters",
        "Coordinate Space": "Global",
    }
    said = ("Type", "Name", "ID", "") if words else ("",) * 4
    head = [[cell for claim in claims.items() for cell in claim], []]
    for k, kind in enumerate(said):
        values = [column[0 if k == 0 else 1 if k == 1 else 2] if k != 2 else "A1:B2" for column in columns]
        head.append(["", kind, *values])
    head.append(["Frame", "Time (Seconds)", *(column[3] for column in columns)])
    lines = []
    for k, frame in enumerate(x):
        sized = np.c_[frame, np.full(len(frame), 14.0)]
        lines.append(
            row(
                k,
                f"{k / rate:.6f}",
                0.0,
                0.0,
                0.0,
                1.0,
                7.0,
                8.0,
                9.0 + k,
                0.01,
                1.5,
                2.5,
                3.5,
                *sized.ravel().tolist(),
            )
        )
    return table([*head, *lines], ",")


def vicon(
    x: np.ndarray, names: Sequence[str] = NAMES, rate: float = 100.0, separator: str = ",", first: int = 301
) -> str:
    """Return a CSV file of Nexus with forces before the trajectories, and velocities after them."""
    devices = [["Devices"], ["1000"], ["", "", "Plate - Force"], ["Frame", "Sub Frame", "Fx"], ["", "", "N"],
               ["301", "0", "1.5"], []]  # fmt: skip
    titles = [cell for name in names for cell in (name, "", "")]
    head = [["Trajectories"], [f"{rate:g}"], ["", "", *titles, names[0]],
            ["Frame", "Sub Frame", *("XYZ" * len(names)), "X'"],
            ["", "", *["mm"] * (3 * len(names)), "mm/s"]]  # fmt: skip
    lines = [row(first + k, 0, *frame.ravel().tolist(), 99.0) for k, frame in enumerate(x)]
    after = [
        [],
        ["Joints"],
        [f"{rate:g}"],
        ["", "", "Arm"],
        ["Frame", "Sub Frame", "RX"],
        ["", "", "deg"],
        ["301", "0", "1"],
    ]
    return table([*devices, *head, *lines, *after], separator)


def qualisys(
    x: np.ndarray, names: Sequence[str] = NAMES, rate: float = 100.0, *, columns: bool = True, clock: int = 2,
    gap: str = "",
) -> str:  # fmt: skip
    """Return a TSV file of Qualisys, with or without names of columns, and 0, 1 or 2 columns before the markers."""
    head = [["NO_OF_FRAMES", str(len(x))], ["NO_OF_CAMERAS", "8"], ["NO_OF_MARKERS", str(len(names))],
            ["FREQUENCY", f"{rate:g}"], ["NO_OF_ANALOG", "0"], ["DESCRIPTION", "--"],
            ["TIME_STAMP", "2024-04-15, 10:39:38.777", "406646.66"], ["DATA_INCLUDED", "3D"],
            ["EVENT", "go", "1", "0.0"], ["MARKER_NAMES", *names],
            ["TRAJECTORY_TYPES", *["Measured"] * len(names)]]  # fmt: skip
    if columns:
        head.append([*["Frame", "Time"][:clock], *(f"{name} {axis}" for name in names for axis in "XYZ")])
    lines = [[*row(k + 1, f"{k / rate:.5f}")[:clock], *(cell or gap for cell in row(*frame.ravel().tolist()))]
             for k, frame in enumerate(x)]  # fmt: skip
    return table([*head, *lines], "\t")


def trc(x: np.ndarray, names: Sequence[str] = NAMES, rate: float = 100.0) -> str:
    """Return a TRC file."""
    keys = ["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units", "OrigDataRate", "OrigDataStartFrame",
            "OrigNumFrames"]  # fmt: skip
    values = [f"{rate:g}", f"{rate:g}", str(len(x)), str(len(names)), "mm", f"{rate:g}", "1", str(len(x))]
    titles = [cell for name in names for cell in (name, "", "")]
    axes = [f"{axis}{k + 1}" for k in range(len(names)) for axis in "XYZ"]
    head = [
        ["PathFileType", "4", "(X/Y/Z)", "beam.trc"],
        keys,
        values,
        ["Frame#", "Time", *titles],
        ["", "", *axes],
        [],
    ]
    lines = [row(k + 1, f"{k / rate:.3f}", *frame.ravel().tolist(), "") for k, frame in enumerate(x)]
    return table([*head, *lines], "\t")


FORMATS: dict[str, tuple[str, Callable[..., str]]] = {
    "wide": (".csv", wide), "long": (".csv", long), "motive": (".csv", motive), "vicon": (".csv", vicon),
    "qualisys": (".tsv", qualisys), "trc": (".trc", trc),
}  # fmt: skip
"""Ending of the name and content, by format."""
