"""The files that `cqrun new` writes: from templates, or with a scene for a recording. None is overwritten unasked."""

from __future__ import annotations

import keyword
import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from cqrun.errors import UsageError
from cqrun.explain import listed, suggest
from cqrun.jobs.new.fit_scene import fit_scene, text_of
from cqrun.jobs.new.lengths import Given
from cqrun.jobs.new.proposal import NOTHING
from cqrun.plugin.registry import FOLDERS, plugins
from cqrun.scene.data import Recording
from cqrun.scene.material import Material
from cqrun.store.atomic import make_directory, write_text

TEMPLATES = Path(__file__).parents[2] / "templates"
YAML = (".yaml", ".yml")

WORDS = {"material_term": tuple(Material.model_fields), "measurement": tuple(Recording.model_fields)}
"""Keys beside which the names of plug-ins of a kind stand in a scene."""

IN_SCENES = "my_scene"
"""What a template of a scene calls itself."""


@dataclass(frozen=True)
class Written:
    """The files that were written, what was found in a recording, what to check in order, and what to type next."""

    files: tuple[Path, ...]
    next: str
    found: tuple[str, ...] = ()
    guesses: tuple[str, ...] = ()


def scene_templates() -> list[str]:
    """Return the names of the scenes that can be written without a recording."""
    return sorted(path.stem for path in (TEMPLATES / "scenes").glob("*.yaml"))


def new_scene(kind: str, scene: Path, *, overwrite: bool = False) -> Written:
    """Write a scene of a kind, with the data that it reads.

    Args:
        kind: one of `scene_templates`.
        scene: the file; `.yaml` is added to a name without an ending.

    Raises:
        UsageError: the name is none for a scene, or a file is there already.
    """
    scene = _scene_file(scene)
    text = (TEMPLATES / "scenes" / f"{kind}.yaml").read_text()
    data = scene.with_suffix(".csv")
    text = text.replace(f"file: {IN_SCENES}.csv", f"file: {text_of(data.name)}").replace(IN_SCENES, _in_comments(scene))
    files = {scene: text}
    example = TEMPLATES / "scenes" / f"{kind}.csv"
    if example.is_file():
        files[data] = example.read_text()
    return Written(_write(files, overwrite), _validate(scene))


def new_fit(
    markers: Path, scene: Path, units: str | None = None, given: Given = NOTHING, *, overwrite: bool = False
) -> Written:
    """Write a scene that is fitted to a recording of markers; arguments as `fit_scene`.

    Raises:
        UsageError: the name is none for a scene, a file is there already, or what is given does not fit the recording.
        DataError: the recording cannot be used.
    """
    scene = _scene_file(scene)
    _require_free([scene], overwrite)
    proposed = fit_scene(markers, scene, units, given)
    return Written(_write({scene: proposed.text}, overwrite), _validate(scene), proposed.found, proposed.guesses)


def new_plugin(kind: str, name: str, folder: Path, *, overwrite: bool = False) -> Written:
    """Write a plug-in of a kind and a scene that uses it.

    Raises:
        UsageError: there is no such kind, the name cannot be used, or a file is there already.
    """
    if kind not in FOLDERS:
        near = suggest(kind, FOLDERS)
        raise UsageError(f"there is no kind of plug-in called '{kind}'{near}; kinds: {listed(FOLDERS)}")
    _require_name(kind, name)
    files = {
        folder / f"{name}{path.suffix}": _renamed(path.read_text(), kind, name)
        for path in sorted((TEMPLATES / "plugins").glob(f"{kind}.*"), key=lambda path: path.suffix != ".py")
    }
    return Written(_write(files, overwrite), f"{_validate(folder / f'{name}.yaml')} --allow-plugins")


def _require_name(kind: str, name: str) -> None:
    """Raise a UsageError for a name that no plug-in of a kind can have."""
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or keyword.iskeyword(name):
        meant = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_").lower()
        legal = re.fullmatch(r"[a-z][a-z0-9_]*", meant) and not keyword.iskeyword(meant)
        raise UsageError(
            f"'{name}' cannot be the name of a plug-in: small letters, digits and _, beginning with a letter"
            + (f", such as {meant}" if legal and meant != name else "")
        )
    if name in plugins(kind) or name in WORDS.get(kind, ()):
        raise UsageError(f"'{name}' means something else for the kind {kind} already: choose another name")


def _renamed(text: str, kind: str, name: str) -> str:
    """Return a template with the user's name for its plug-in, and a class of this name that means nothing else."""
    if name == f"my_{kind}":
        return text
    camel = _camel(name)
    camel += "Plugin" if re.search(rf"\b{camel}(Kernel)?\b", text) else ""
    return text.replace(f"my_{kind}", name).replace(f"My{_camel(kind)}", camel)


def _camel(name: str) -> str:
    return "".join(part.capitalize() for part in name.split("_"))


def _scene_file(scene: Path) -> Path:
    """Return the file of a scene; `.yaml` is added to a name without an ending."""
    if not scene.name or scene.name == "..":
        raise UsageError(f"{scene}: is a folder; name the file of the scene, such as beam.yaml")
    if not scene.suffix:
        scene = scene.with_name(f"{scene.name}.yaml")
    if scene.suffix.lower() not in YAML:
        raise UsageError(f"{scene}: the name of a scene ends in .yaml, not in '{scene.suffix}'")
    return scene


def _in_comments(scene: Path) -> str:
    return shlex.quote(scene.stem)


def _validate(scene: Path) -> str:
    return f"cqrun validate {shlex.quote(str(scene))}"


def _require_free(files: list[Path], overwrite: bool) -> None:
    """Raise a UsageError for a file that is there already."""
    for path in files:
        if path.is_dir():
            raise UsageError(f"{path}: is a folder; choose another name")
        if not overwrite and (path.exists() or path.is_symlink()):
            raise UsageError(f"{path}: is there already; choose another name, or overwrite it with --force")


def _write(files: Mapping[Path, str], overwrite: bool) -> tuple[Path, ...]:
    """Write files, none of them if one is there already."""
    _require_free(list(files), overwrite)
    for path, text in files.items():
        make_directory(path.parent)
        write_text(path, text)
    return tuple(files)
