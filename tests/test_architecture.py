"""The architecture: imports go only downward, files are small, and scenes are short."""

from __future__ import annotations

import ast
import fnmatch
import re
import subprocess
import tomllib
from collections.abc import Collection, Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import cqrun

ROOT = Path(cqrun.__file__).parents[1]
PACKAGE = ROOT / "cqrun"

FLOORS = (
    {"characters", "disk", "errors", "explain", "fingerprint", "memory", "state", "units", "version"}
    | {"numerics", "plugin"},
    {"materials", "actuators", "forces", "boundaries", "loads"},
    {"geometry", "observers", "controllers", "objectives", "measures", "measurements", "optimizers"}
    | {"engine", "design"},
    {"scene", "store"},
    {"build"},
    {"running"},
    {"fitting", "learning", "tensile"},
    {"jobs"},
    {"cli", "figures", "report", "templates"},
)
APART = ({"fitting", "learning"},)
"""Rooms of one floor that do not import each other."""
FLOOR_OF = {name: floor for floor, names in enumerate(FLOORS) for name in names}
DOORS = {"", "__main__"}
"""Modules of the package itself: they open every floor and are imported by none of them."""

HEAVY = {"numba", "scipy", "matplotlib", "h5py"}
MOST_LINES, MOST_SCENE_LINES = 400, 50


def modules() -> dict[str, Path]:
    """Return the files of the package by the dotted names of their modules."""
    names = {
        path: path.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".") for path in PACKAGE.rglob("*.py")
    }
    return {name.removesuffix(".__init__"): path for path, name in sorted(names.items())}


def tracked() -> list[Path]:
    """Return the files that git tracks or would add."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    listing = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [path for name in listing.splitlines() if (path := ROOT / name).is_file()]


def room(module: str) -> str:
    """Return the part of the package a module belongs to: its folder or, on the top level, its own name."""
    return module.split(".")[1] if "." in module else ""


def imported(module: str, source: str, known: Collection[str]) -> Iterator[tuple[int, str]]:
    """Yield line and module of every import of the package's own, those inside functions and for types alone too."""
    package = module.split(".") if module in PACKAGES else module.split(".")[:-1]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            origin = ".".join([*base, *([node.module] if node.module else [])])
            names = [full if (full := f"{origin}.{alias.name}") in known else origin for alias in node.names]
        else:
            continue
        yield from ((node.lineno, name) for name in names if name in known and name != module)


PACKAGES = {name for name, path in modules().items() if path.name == "__init__.py"}


def problems(sources: Mapping[str, str]) -> list[str]:
    """Return what is wrong with the imports of modules, given their sources by name."""
    found, uses = [], dict[str, set[str]]()
    for module, source in sources.items():
        uses[module] = set()
        for line, name in imported(module, source, sources):
            here, there = room(module), room(name)
            if here in FLOOR_OF and there in DOORS:
                found.append(
                    f"{module}:{line}: floor {FLOOR_OF[here]} imports the package itself, which opens every floor"
                )
            if here not in FLOOR_OF or there not in FLOOR_OF:  # a door, or what the test of floors names
                continue
            uses[module].add(name)
            if FLOOR_OF[there] > FLOOR_OF[here]:
                found.append(f"{module}:{line}: floor {FLOOR_OF[here]} imports {name}")
            if here != there and any({here, there} <= apart for apart in APART):
                found.append(f"{module}:{line}: {here} and {there} do not import each other: {name}")
    try:
        TopologicalSorter(uses).prepare()
    except CycleError as error:
        found.append(f"circle: {' -> '.join(error.args[1])}")
    return found


@pytest.fixture(scope="module")
def sources() -> dict[str, str]:
    return {name: path.read_text() for name, path in modules().items()}


def test_every_module_has_a_floor(sources):
    rooms = {room(name) for name in sources} - DOORS
    assert rooms <= FLOOR_OF.keys(), f"not on any floor: {sorted(rooms - FLOOR_OF.keys())}"


def test_imports_go_downward_and_in_no_circle_file_by_file(sources):
    found = problems(sources)
    assert not found, "\n".join(found)


MUTATIONS = {
    "upward": ("cqrun.engine.updated.step", "import cqrun.jobs.sysid\n", "floor 2 imports cqrun.jobs.sysid"),
    "upward, relative": (
        "cqrun.engine.updated.step", "from ...jobs import sysid\n", "floor 2 imports cqrun.jobs.sysid",
    ),
    "upward, in a function": (
        "cqrun.store.run", "def f():\n    from cqrun.running import runs\n", "floor 3 imports cqrun.running.runs",
    ),
    "upward, through the package itself": (
        "cqrun.engine.updated.step", "from cqrun import load\n", "floor 2 imports the package itself",
    ),
    "upward, through the command line": (
        "cqrun.engine.updated.step", "import cqrun.__main__\n", "floor 2 imports the package itself",
    ),
    "a circle of files in one room": (
        "cqrun.engine.updated.setting", "from cqrun.engine.updated import step\n", "circle: cqrun.engine.",
    ),
    "a circle for types alone": (
        "cqrun.scene.sections",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from cqrun.scene.schema import Scene\n",
        "circle: cqrun.scene.",
    ),
    "a circle inside a function": (
        "cqrun.store.formats.long_table", "def f():\n    import cqrun.store.recordings\n", "circle: cqrun.store.",
    ),
    "rooms that are apart": (
        "cqrun.fitting.problem", "from cqrun.learning.agent import Agent\n", "do not import each other: cqrun.learning",
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", MUTATIONS)
def test_the_walk_finds_every_kind_of_wrong_import(name, sources):
    module, line, message = MUTATIONS[name]
    source = sources[module].replace(
        "from __future__ import annotations\n", f"from __future__ import annotations\n{line}", 1
    )
    assert any(message in problem for problem in problems({**sources, module: source}))


def test_every_test_is_collected(pytestconfig):
    """A folder that pytest passes over would lose its tests without a message."""
    passed_over = pytestconfig.getini("norecursedirs")
    folders = {part for path in (ROOT / "tests").rglob("test_*.py") for part in path.relative_to(ROOT).parts[:-1]}
    assert not [(name, p) for name in folders for p in passed_over if fnmatch.fnmatch(name, p)]


def test_modules_are_short():
    sources = [path for path in tracked() if path.suffix == ".py"]
    long = [f"{p.relative_to(ROOT)}: {n} lines" for p in sources if (n := _lines(p)) >= MOST_LINES]
    assert not long, "\n".join(long)


def test_scenes_have_at_most_fifty_lines():
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


def test_no_file_contains_a_path_of_a_machine():
    place = re.compile(r"(^|[^a-zA-Z.])/(" + "|".join(("work", "tmp", "root", "farm", "home", "Users")) + r")/")
    lines_with_paths = []
    for path in tracked():
        if path == Path(__file__):
            continue
        text = path.read_bytes()
        if b"\0" in text:
            continue
        lines = text.decode("utf-8").splitlines()
        lines_with_paths += [
            f"{path.relative_to(ROOT)}:{i}: {line}" for i, line in enumerate(lines, 1) if place.search(line)
        ]
    assert not lines_with_paths, "\n".join(lines_with_paths)


def test_versions_agree():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["version"] == cqrun.__version__


def test_the_constraints_name_every_dependency_once_and_no_address():
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
