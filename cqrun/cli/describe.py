"""`cqrun describe`: show the page of any part of a scene, made from its docstring and fields."""

from __future__ import annotations

import inspect
import typing
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cqrun.cli.options import PluginFiles
from cqrun.cli.terminal import echo
from cqrun.cli.units_page import UNITS
from cqrun.errors import UsageError

if TYPE_CHECKING:
    from pydantic import BaseModel
    from pydantic.fields import FieldInfo

LIMITS = (("gt", ">"), ("ge", ">="), ("lt", "<"), ("le", "<="))


def describe(
    kind: Annotated[
        str | None,
        typer.Argument(help="Kind of plug-in, such as elastic; section of a scene, such as bodies; or units."),
    ] = None,
    name: Annotated[str | None, typer.Argument(help="Name of a plug-in, such as fixed_corotated.")] = None,
    plugin: PluginFiles = None,
) -> None:
    """Show the fields, units, defaults and formula of a part of a scene; without NAME or KIND, show a list."""
    if plugin:
        from cqrun.scene.plugin_files import load_plugin_files

        load_plugin_files(plugin)
    for line in _lines(kind, name):
        echo(line)


def _lines(kind: str | None, name: str | None) -> Iterator[str]:
    if kind is None:
        yield "kinds (cqrun describe KIND [NAME]):"
        yield from (f"  {k:14} {', '.join(_plugins(k))}" for k in _kinds())
        yield "units of a scene, also in 2D, and common mistakes: cqrun describe units"
        yield "parts of a scene (cqrun describe PART):"
        yield f"  {', '.join(_sections())}"
        return
    section = _section_called(kind)
    if name is None and (lines := _part_of_a_scene(kind, section)):
        yield from lines
        if kind != "material":  # its terms are plug-ins, which are listed, too
            return
    kinds = _kinds_called(kind, name)
    # a shape is also a region, but it is listed only once
    entries = [(k, n, cls) for k in kinds for n, cls in _plugins(k).items() if len(kinds) == 1 or cls.kind == k]
    if name is None and not any(kind == n for _, n, _ in entries):
        yield from (f"{k} {n}: {_summary(cls)}" for k, n, cls in entries)
        return
    requested = name or kind
    pages = [entry for entry in entries if entry[1] == requested]
    if not pages:
        from cqrun.explain import listed, suggest

        names = [n for _, n, _ in entries]
        raise UsageError(f"no {kind} is called '{requested}'{suggest(requested, names)}; there are: {listed(names)}")
    for k, n, cls in pages:
        yield from _page(k, n, cls)
    if name is None and section is not None:
        yield f"for the section `{section}` of a scene: cqrun describe {section}"


def _part_of_a_scene(word: str, section: str | None) -> list[str]:
    """Return the page of the units, of a section, or of one field of a scene; empty if a word means plug-ins."""
    from cqrun.scene.schema import Scene

    if word == "units":
        return UNITS.splitlines()
    if section is not None and (section == word or not _is_a_plugin(word)):
        return list(_page("scene", section, _sections()[section]))
    info = Scene.model_fields.get(word)
    if info is None or _choices(info) or word == "regions":  # their plug-ins are listed
        return []
    return [f"scene: {word}", "", *_field(Scene, word, ""), ""]


def _is_a_plugin(word: str) -> bool:
    return word in _kinds() or any(word in _plugins(kind) for kind in _kinds())


def _section_called(word: str) -> str | None:
    """Return the section that a word means: `bodies`, and `body` for one of them."""
    plurals = (word, f"{word}s", f"{word[:-1]}ies")
    return next((section for section in _sections() if section in plurals), None)


def _sections() -> dict[str, type[BaseModel]]:
    """Return the parts of a scene that are not plug-ins, by their key; `scene` is the whole scene."""
    from cqrun.scene.schema import Scene

    sections: dict[str, type[BaseModel]] = {"scene": Scene}
    waiting: list[type[BaseModel]] = [Scene]
    while waiting:
        for name, info in waiting.pop(0).model_fields.items():
            for spec in [] if _choices(info) else _specs(info.annotation):
                if name not in sections:
                    sections[name] = spec
                    waiting.append(spec)
    return sections


def _kinds() -> list[str]:
    """Return the kinds of plug-ins."""
    from cqrun.plugin.registry import FOLDERS

    return list(FOLDERS)


def _plugins(kind: str) -> dict[str, Any]:
    from cqrun.plugin.registry import plugins

    return plugins(kind)


def _kinds_called(word: str, name: str | None) -> list[str]:
    """Return the kinds that a word means: itself, the kinds of a folder, or those with a plug-in of that name."""
    from cqrun.explain import listed, suggest
    from cqrun.plugin.registry import FOLDERS

    kinds = _kinds()
    if word in kinds:
        return [word]
    if word.removesuffix("s") in kinds:
        return [word.removesuffix("s")]
    in_folder = [k for k in kinds if FOLDERS[k].rpartition(".")[2] in (word, f"{word}s")]
    if in_folder:
        return in_folder
    everything = {k: list(_plugins(k)) for k in kinds}
    named = [k for k, names in everything.items() if word in names]
    if named and name is None:
        return named
    if owners := [section for section, spec in _sections().items() if word in spec.model_fields]:
        pages = " and ".join(f"`cqrun describe {owner}`" for owner in owners)
        raise UsageError(f"'{word}' has no page of its own: it is a field, described by {pages}")
    near = suggest(word, [*kinds, *_sections(), *(n for names in everything.values() for n in names)])
    raise UsageError(f"nothing is called '{word}'{near}; kinds: {listed(kinds)}; parts: {listed(_sections())}")


def _summary(cls: type) -> str:
    return inspect.cleandoc(cls.__doc__ or "").partition("\n")[0]


def _page(kind: str, name: str, cls: type[BaseModel]) -> Iterator[str]:
    yield f"{kind}: {name}"
    yield ""
    yield from (f"  {line}".rstrip() for line in inspect.cleandoc(cls.__doc__ or "").splitlines())
    yield ""
    yield from _fields(cls, "")
    yield ""


def _fields(cls: type[BaseModel], indent: str) -> Iterator[str]:
    if not cls.model_fields and cls.model_config.get("extra") != "allow":  # else its docstring says what its keys are
        yield f"{indent}  no fields"
    for name in cls.model_fields:
        yield from _field(cls, name, indent)


def _field(cls: type[BaseModel], name: str, indent: str) -> Iterator[str]:
    facts, text = facts_of(cls, name)
    yield f"{indent}  {name}: {facts}"
    if text:
        yield f"{indent}      {text}"
    for spec in parts_of(cls, name):
        yield from _fields(spec, indent + "    ")


def facts_of(cls: type[BaseModel], name: str) -> tuple[str, str]:
    """Return unit, kind of value, limits and default of a field, in one line; and what it means."""
    from cqrun.plugin.contract import field_unit, is_differentiable, is_geometric

    info, unit = cls.model_fields[name], field_unit(cls, name)
    facts = [f"[{unit}]" if unit else "", _what(info), _range(info), _default(info)]
    facts.append("differentiable" if is_differentiable(cls, name) else "")
    facts.append("differentiable in a body" if is_geometric(cls, name) else "")
    return ", ".join(fact for fact in facts if fact), (info.description or "").removesuffix(f" [{unit}]")


def parts_of(cls: type[BaseModel], name: str) -> list[type[BaseModel]]:
    """Return the parts of a scene that are inside a field; plug-ins are not: each has its own page."""
    info = cls.model_fields[name]
    return [] if _choices(info) else _specs(info.annotation)


def _specs(annotation: Any) -> list[type[BaseModel]]:
    """Return the parts of a scene that are nested in an annotation."""
    from cqrun.plugin.contract import Spec

    return [part for part in _parts(annotation) if inspect.isclass(part) and issubclass(part, Spec)]


def _parts(annotation: Any) -> Iterator[Any]:
    """Yield an annotation and all its components."""
    yield annotation
    for part in typing.get_args(annotation):
        yield from _parts(part)


def _choices(info: FieldInfo) -> list[str]:
    """Return the kinds of plug-in a field chooses from."""
    from cqrun.plugin.choice import Choice
    from cqrun.plugin.reference import marks

    return [mark.kind for mark in marks(info, Choice)]


def _what(info: FieldInfo) -> str:
    """Return the type of a field's value, in words for users."""
    chosen = _choices(info)
    kinds = {typing.get_origin(part) or part for part in _parts(info.annotation) if part is not typing.Any}
    several = list in kinds or dict in kinds
    if chosen:
        what = " or ".join(chosen)
        return f"{'several of' if several else 'choice of'} {what} (cqrun describe {chosen[0]})"
    mappings = [part for part in _parts(info.annotation) if typing.get_origin(part) is dict]
    parts = list(_parts(typing.get_args(mappings[0])[1] if mappings else info.annotation))
    words = [str(v) for part in parts if typing.get_origin(part) is typing.Literal for v in typing.get_args(part)]
    names = {float: "number", int: "whole number", bool: "true or false", str: "text"}
    words += list(dict.fromkeys(names[part] for part in parts if part in names))
    from annotated_types import MaxLen, MinLen

    if MinLen(2) in info.metadata and MaxLen(3) in info.metadata:
        return "a number for each dimension"
    none = "its fields" if _specs(info.annotation) else "value"
    lists = "list of " * _depth(info.annotation)
    return ("name -> " if dict in kinds else "") + lists + " | ".join(words or [none])


def _depth(annotation: Any) -> int:
    """Return how many lists are nested in an annotation, not counting mappings."""
    parts, origin = typing.get_args(annotation), typing.get_origin(annotation)
    if origin is typing.Literal:
        return 0
    return (origin is list) + max(map(_depth, parts), default=0)


def _range(info: FieldInfo) -> str:
    limits = [(sign, getattr(mark, key, None)) for key, sign in LIMITS for mark in info.metadata]
    return " and ".join(f"{sign} {limit}" for sign, limit in limits if limit is not None)


def _default(info: FieldInfo) -> str:
    from cqrun.plugin.reference import FilledIn, marks

    if info.is_required():
        return "optional" if marks(info, FilledIn) else "required"
    default = info.get_default() if info.default_factory is None else None
    return "optional" if default in (None, "") else f"default {default}"
