"""The house keeps its floors: imports go downward, files stay small, scenes stay short."""

from __future__ import annotations

import ast
import re
import subprocess
import tomllib
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import cqrun

ROOT = Path(cqrun.__file__).parents[1]
PACKAGE = ROOT / "cqrun"

FLOORS = (
    {"contract", "registry", "units", "errors", "explain", "choice", "fingerprint"},
    {"tensor", "lanes", "polar", "compile", "packed", "records", "wide_records", "state"},
    {"materials", "actuators", "boundaries", "loads"},
    {"engine"},
    {"geometry", "observers", "controllers", "objectives", "measurements", "design", "optimizers"},
    {"scene", "store"},
    {"jobs"},
    {"cli", "figures"},
)
FLOOR_OF = {name: floor for floor, names in enumerate(FLOORS) for name in names}
DOORS = {"__init__", "__main__"}
"""Modules of the package itself: they open every floor and are imported by none of them."""

HEAVY = {"numba", "scipy", "matplotlib", "h5py"}
MOST_LINES, MOST_SCENE_LINES = 400, 50


def modules() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def tracked() -> list[Path]:
    """Return the files git knows or would add."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    listing = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [path for name in listing.splitlines() if (path := ROOT / name).is_file()]


def room(path: Path) -> str:
    """Return the part of the package a file belongs to: its folder or, on the top level, its own name."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line and dotted name of every import in a file, those inside functions too."""
    package = [*path.relative_to(ROOT).parts[:-1]]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            source = ".".join([*base, *([node.module] if node.module else [])])
            yield from ((node.lineno, f"{source}.{alias.name}") for alias in node.names)


def test_every_module_has_a_floor():
    rooms = {room(path) for path in modules()} - DOORS
    assert rooms <= FLOOR_OF.keys(), f"not on any floor: {sorted(rooms - FLOOR_OF.keys())}"


def test_imports_go_downward():
    upward = []
    for path in modules():
        here = room(path)
        if here not in FLOOR_OF:  # a door, or what the test above names
            continue
        for line, name in imported(path):
            parts = name.split(".")
            if parts[0] != "cqrun" or parts[1:] == ["__version__"]:
                continue
            there = FLOOR_OF.get(".".join(parts[1:2]), len(FLOORS))
            if there > FLOOR_OF[here]:
                upward.append(f"{path.relative_to(ROOT)}:{line}: floor {FLOOR_OF[here]} imports {name}")
    assert not upward, "\n".join(upward)


def test_rooms_of_one_floor_import_each_other_in_no_circle():
    uses: dict[str, set[str]] = {}
    for path in modules():
        here = room(path)
        found = {name.split(".")[1] for _, name in imported(path) if name.startswith("cqrun.")} - {here}
        uses.setdefault(here, set()).update(there for there in found if there in FLOOR_OF)
    TopologicalSorter(uses).prepare()  # raises CycleError, which names the circle


def test_the_walk_sees_imports_of_every_form():
    nested = PACKAGE / "engine" / "__init__.py"
    source = "import cqrun.jobs.sysid\nfrom cqrun import jobs\ndef f():\n    from ..jobs import sysid\n"
    stand_in = _Text(nested, source)
    assert [name for _, name in imported(stand_in)] == ["cqrun.jobs.sysid", "cqrun.jobs", "cqrun.jobs.sysid"]


class _Text:
    """A file's place with other contents."""

    def __init__(self, place: Path, text: str) -> None:
        self.relative_to, self.read_text = place.relative_to, lambda: text


def test_modules_are_one_room():
    sources = [path for path in tracked() if path.suffix == ".py"]
    long = [f"{p.relative_to(ROOT)}: {n} lines" for p in sources if (n := _lines(p)) >= MOST_LINES]
    assert not long, "\n".join(long)


def test_scenes_fit_fifty_lines():
    scenes = sorted((ROOT / "scenes").rglob("*.yaml"))
    long = [f"{p.relative_to(ROOT)}: {n} lines" for p in scenes if (n := _lines(p)) > MOST_SCENE_LINES]
    assert not long, "\n".join(long)
    stems = [p.stem for p in scenes]
    assert len(stems) == len(set(stems)), "two scenes share a stem, hence a results folder"


def test_commands_import_nothing_heavy_at_the_top():
    heavy = []
    for path in sorted((PACKAGE / "cli").glob("*.py")):
        for node in ast.parse(path.read_text()).body:
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            heavy += [f"{path.name}:{node.lineno}: {n}" for n in names if n.split(".")[0] in HEAVY]
    assert not heavy, "\n".join(heavy)


def test_no_path_of_one_machine_in_the_tree():
    place = re.compile(r"(^|[^a-zA-Z.])/(" + "|".join(("work", "tmp", "root", "farm", "home", "Users")) + r")/")
    found = []
    for path in tracked():
        if path == Path(__file__):
            continue
        text = path.read_bytes()
        if b"\0" in text:
            continue
        lines = text.decode("utf-8").splitlines()
        found += [f"{path.relative_to(ROOT)}:{i}: {line}" for i, line in enumerate(lines, 1) if place.search(line)]
    assert not found, "\n".join(found)


def test_versions_agree():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["version"] == cqrun.__version__


def test_the_lock_names_every_dependency_once_and_no_address():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    lines = [x for x in (ROOT / "constraints.txt").read_text().splitlines() if x and not x.startswith("#")]
    assert all(re.fullmatch(r"[A-Za-z0-9_.-]+==[A-Za-z0-9.+]+", line) for line in lines)
    locked = [_canonical(line.partition("==")[0]) for line in lines]
    assert len(locked) == len(set(locked))
    wanted = [*project["project"]["dependencies"], *project["project"]["optional-dependencies"]["dev"]]
    wanted += project["build-system"]["requires"]
    assert {_canonical(re.match(r"[A-Za-z0-9_.-]+", text).group()) for text in wanted} <= set(locked)


def _canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _lines(path: Path) -> int:
    return len(path.read_text().splitlines())
