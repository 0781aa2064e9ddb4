"""Materials from elsewhere: `material: {card: NAME}` and `material: {file: NAME}`, replaced by what they contain.

Keys beside `card` or `file` override it: `density`, a term such as `viscosity`, values of the law, another law, and
`poissons_ratio` or `bulk_modulus` of the law. A term that is null is left out. So everything after this sees an
ordinary material, and the scene in a run directory has all numbers.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

from pydantic_core import InitErrorDetails

import cqrun.materials
from cqrun.errors import Problem, SceneError, UsageError
from cqrun.explain import Loc, complaint, finding, listed, shown, suggest
from cqrun.plugin.reference import why_unreadable
from cqrun.scene.document import read, text_of

CARD, FILE = "card", "file"
CARDS = Path(cqrun.materials.__file__).parent / "cards"
"""Folder of the cards: a YAML file each, with what is known of the material, and the part of a scene (`material`)."""

VOLUME = ("bulk_modulus", "poissons_ratio")
"""Keys beside a fragment that are values of its law; it has one of them."""

BATCHES = (
    "Batches, mixing, curing and age differ: the same product often differs by 20 % or more from a card, and crosshead "
    "strain by as much again. Test your own specimen (cqrun material FILES) or fit the modulus to a recording."
)


def with_fragments(data: Any, path_of: Callable[[str], Path]) -> Any:
    """Return a scene's plain data with its cards and files of materials replaced by their content.

    Args:
        data: of the scene; the schema reports unexpected data.
        path_of: returns the path of a file that the scene names.

    Raises:
        ValidationError: there is no such card or file, or both are named. SceneError: a file is no YAML mapping.
    """
    bodies = data.get("bodies") if isinstance(data, dict) else None
    if not isinstance(bodies, dict):
        return data
    findings: list[InitErrorDetails] = []
    resolved = {name: _body(body, ("bodies", name), path_of, findings) for name, body in bodies.items()}
    if findings:
        raise complaint("Scene", findings)
    return {**data, "bodies": resolved}


def _body(body: Any, loc: Loc, path_of: Callable[[str], Path], findings: list[InitErrorDetails]) -> Any:
    if not isinstance(body, dict):
        return body
    found = dict(body)
    if "material" in body:
        found["material"] = _material(body["material"], (*loc, "material"), path_of, findings)
    if isinstance(body.get("material_of"), dict):
        found["material_of"] = {
            name: _material(part, (*loc, "material_of", name), path_of, findings)
            for name, part in body["material_of"].items()
        }
    return found


def _material(part: Any, loc: Loc, path_of: Callable[[str], Path], findings: list[InitErrorDetails]) -> Any:
    if not isinstance(part, dict) or not (CARD in part or FILE in part):
        return part
    if CARD in part and FILE in part:
        findings.append(finding("names a card and a file: keep one", (*loc, FILE)))
        return part
    key = CARD if CARD in part else FILE
    name = part[key]
    if not isinstance(name, str):
        findings.append(finding(f"must be the name of a {key}, is {shown(name)}", (*loc, key)))
        return part
    if key == CARD and name not in cards():
        message = (
            f"there is no card of this name{suggest(name, cards())}; cards: {listed(cards())} (cqrun material --list)"
        )
        findings.append(finding(message, (*loc, key)))
        return part
    if key == FILE and (why := why_unreadable(path_of(name))):
        message = f"{path_of(name)}: cannot be read ({why}); the name starts from the scene's folder"
        findings.append(finding(message, (*loc, key)))
        return part
    content = cards()[name]["material"] if key == CARD else read_fragment(path_of(name))
    return merged(content, {k: v for k, v in part.items() if k != key})


def merged(fragment: dict[str, Any], beside: dict[str, Any]) -> dict[str, Any]:
    """Return a material: that of a fragment, with the keys beside it in its place."""
    found = {**fragment, **{k: v for k, v in beside.items() if k not in ("elastic", *VOLUME)}}
    law = dict(fragment["elastic"]) if isinstance(fragment.get("elastic"), dict) else {}
    other = beside.get("elastic")
    if isinstance(other, dict) and other.keys() == law.keys() and all(isinstance(v, dict) for v in other.values()):
        law = {name: _values({**law[name]}, values) for name, values in other.items()}
    elif "elastic" in beside:
        law = other  # type: ignore[assignment]  # the schema reports what is no mapping
    volume = {k: beside[k] for k in VOLUME if k in beside}
    if volume and isinstance(law, dict):
        law = {name: _values(values, volume) if isinstance(values, dict) else values for name, values in law.items()}
    if law:
        found["elastic"] = law
    return {k: v for k, v in found.items() if v is not None}


def _values(values: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """Return the values of a law with others in their place; bulk modulus and Poisson's ratio replace each other."""
    replaced = VOLUME if any(key in other for key in VOLUME) else ()
    return {**{k: v for k, v in values.items() if k not in replaced}, **other}


def read_fragment(path: Path) -> dict[str, Any]:
    """Return the plain data of a file with a part of a material, such as `cqrun material` writes.

    Raises:
        SceneError: it is no YAML mapping.
    """
    try:
        content = read(text_of(path), str(path)).data
    except OSError as error:
        raise SceneError([Problem(str(path), "", f"cannot be read: {error.strerror}")]) from None
    if not isinstance(content, dict) or "bodies" in content:
        what = "is a scene" if isinstance(content, dict) else f"is {shown(content)}"
        message = f"{what}; the file of a material has its terms, such as `elastic: {{yeoh: {{...}}}}`"
        raise SceneError([Problem(f"{path}:1:1", "", message)])
    return content


@cache
def cards() -> dict[str, dict[str, Any]]:
    """Return all cards by name, as plain data."""
    return {path.stem: read(path.read_text(encoding="utf-8"), path.name).data for path in sorted(CARDS.glob("*.yaml"))}


def card_lines() -> Iterator[str]:
    """Yield the lines of the list of cards."""
    width = max((len(name) for name in cards()), default=0)
    for name, card in cards().items():
        yield f"{name:{width}}  {card['title']}: {card['summary']}"
    yield ""
    yield "In a scene: material: {density: 1070, card: NAME}. `cqrun material --card NAME` shows source and spread."
    yield from textwrap.wrap(BATCHES, 110)


def card_text(name: str) -> str:
    """Return the text of a card, with the warning that batches differ.

    Raises:
        UsageError: there is no such card.
    """
    if name not in cards():
        raise UsageError(f"--card {name}: there is no card of this name{suggest(name, cards())}: {listed(cards())}")
    warning = "\n".join(textwrap.wrap(BATCHES, 110))
    return f"{(CARDS / f'{name}.yaml').read_text(encoding='utf-8').rstrip()}\n\n{warning}"
