"""Read YAML text as plain data with the position of every part, and write plain data as YAML text.

Scalars are read as in the core schema of YAML 1.2: `1e4` is a number, `no`, `on` and `1:30` are text, `010` is ten.
Tags are refused, so that no text can build an object or run code. Aliases may repeat a part, but only a limited number
of times.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from cqrun.characters import instead_of, lookalikes
from cqrun.errors import Problem, SceneError
from cqrun.explain import Loc, shown

MAX_CHARACTERS = 500_000
"""Longer texts take half a minute to read; a scene names files for what is that long."""

MAX_ALIASED_NODES = 100_000
MAX_DEPTH = 100
MAX_DIGITS = 400
"""More than any number has that a machine holds; Python takes long to read longer ones."""

_RESOLVERS = [
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+", list("-+0123456789")),
    (
        "float",
        r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
        list("-+.0123456789"),
    ),
]


_EXPONENT = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)[eE][-+]?[0-9]+")
"""A number that PyYAML reads as text: in YAML 1.1 it must have a point, and a sign in its exponent."""


class _Loader(yaml.SafeLoader):
    """Reads text as nodes; `_Builder` turns them into data."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012 (PyYAML's own way)


class _Dumper(yaml.SafeDumper):
    """Writes plain data so that `_Loader` reads the same data: it quotes text by the same resolvers."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012

    def ignore_aliases(self, data: Any) -> bool:
        return True


for _name, _pattern, _first in _RESOLVERS:
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(f"tag:yaml.org,2002:{_name}", re.compile(rf"(?:{_pattern})\Z"), _first)


@dataclass(frozen=True)
class Document:
    """Plain data and, if it came from text, the YAML nodes that it was made from.

    `name` is the file's name as the user typed it, or `scene` for data without a file.
    """

    data: Any
    name: str = "scene"
    node: yaml.Node | None = field(default=None, repr=False)

    def where(self, loc: Loc, *, at_key: bool = False) -> str:
        """Return `file:line:column` of a place, or of the smallest part around it that is in the text.

        Args:
            loc: keys and indices from the root.
            at_key: return the position of the last key even if its value is a scalar.
        """
        line, column = self.position(loc, at_key=at_key)
        return f"{self.name}:{line}:{column}" if self.node is not None else self.name

    def has_part_at(self, loc: Loc) -> bool:
        """Return whether the data have a mapping or a list exactly at this place."""
        data = self.data
        for key in loc:
            if isinstance(data, dict) and key in data:
                data = data[str(key)]
            elif isinstance(data, list) and isinstance(key, int) and key < len(data):
                data = data[key]
            else:
                return False
        return isinstance(data, (dict, list))

    def position(self, loc: Loc, *, at_key: bool = False) -> tuple[int, int]:
        """Return line and column, counted from 1, of the place that `where` names."""
        if self.node is None:
            return 0, 0
        mark, node = self.node.start_mark, self.node
        for depth, key in enumerate(loc):
            entry = _entry(node, key)
            if entry is None:
                if _is_shorthand(node, loc[depth:]):
                    continue
                break
            key_mark, node = entry
            scalar = isinstance(node, yaml.ScalarNode) and bool(node.value)
            mark = node.start_mark if scalar and not at_key else key_mark
        return mark.line + 1, mark.column + 1


def _entry(node: yaml.Node, key: int | str) -> tuple[yaml.Mark, yaml.Node] | None:
    """Return the position of a key and the node of its value."""
    if isinstance(node, yaml.MappingNode):
        for key_node, value in node.value:
            if isinstance(key_node, yaml.ScalarNode) and key_node.value == str(key):
                return key_node.start_mark, value
    if isinstance(node, yaml.SequenceNode) and isinstance(key, int) and 0 <= key < len(node.value):
        return node.value[key].start_mark, node.value[key]
    return None


def _is_shorthand(node: yaml.Node, rest: Loc) -> bool:
    """Return whether a list is short for `{shapes: [...]}`, so that the key `shapes` is not in the text."""
    return isinstance(node, yaml.SequenceNode) and len(rest) > 1 and isinstance(rest[1], int)


def read(text: str, name: str = "scene") -> Document:
    """Return the document in a YAML text.

    Raises:
        SceneError: wrong syntax, duplicate keys, tags, or too many repeated aliases; with `name:line:column`.
    """
    if len(text) > MAX_CHARACTERS:
        raise SceneError([Problem(f"{name}:1:1", "", too_long(f"{len(text)} characters"))])
    try:
        node = yaml.compose(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f"{name}:{mark.line + 1}:{mark.column + 1}" if mark else name
        reason = ", ".join(part for part in (error.context, error.problem) if part)
        cause = _strange_character(text, mark.line) if mark else ""
        raise SceneError([Problem(place, "", f"this is not YAML: {reason}{cause}")]) from None
    except yaml.reader.ReaderError as error:
        place = f"{name}:{place_of(text, error.position)}"
        message = f"this is not YAML: the character U+{ord(text[error.position]):04X} is not allowed: remove it"
        raise SceneError([Problem(place, "", message)]) from None
    except RecursionError:
        raise SceneError([Problem(f"{name}:{_deep_place(text)}", "", _too_deep())]) from None
    if node is None:
        raise SceneError([Problem(f"{name}:1:1", "", "is empty; a scene begins with `cqrun: 1`")])
    builder = _Builder(name)
    data = builder.build(node, (), 0)
    if builder.problems:
        raise SceneError(builder.problems)
    return Document(data, name, node)


def text_of(path: Path) -> str:
    """Return the text of a file; no more of it is read than a scene can have.

    Raises:
        OSError: it cannot be read. SceneError: it is too long, or not UTF-8.
    """
    with path.open("rb") as file:
        content = file.read(4 * MAX_CHARACTERS + 1)
    if len(content) > 4 * MAX_CHARACTERS:  # UTF-8 has at most 4 bytes a character
        raise SceneError([Problem(f"{path}:1:1", "", too_long(f"more than {4 * MAX_CHARACTERS:,} bytes"))])
    try:
        return content.decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        before = content[: error.start].decode("utf-8")
        place = place_of(before, len(before))
        raise SceneError([Problem(f"{path}:{place}", "", _why_undecodable(content, error))]) from None


def _why_undecodable(content: bytes, error: UnicodeDecodeError) -> str:
    """Return what a text is instead of UTF-8."""
    advice = "save the scene as UTF-8"
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        return f"this is UTF-16 text: {advice}"
    return f"this is not UTF-8 text: it has the byte 0x{content[error.start]:02x} here; {advice}"


def too_long(size: str) -> str:
    """Return what is wrong with a text of a size."""
    return f"has {size}; a scene has at most {MAX_CHARACTERS:,} characters: give long data in files that it names"


def place_of(text: str, position: int) -> str:
    """Return `line:column`, counted from 1, of a position in a text."""
    return f"{text.count(chr(10), 0, position) + 1}:{position - text.rfind(chr(10), 0, position)}"


def _strange_character(text: str, line: int) -> str:
    """Return the first character that YAML takes for another than eyes do, in a line or in the one before it."""
    lines = text.split("\n")[: line + 1]
    near = [k for k, content in enumerate(lines) if content.strip()][-2:]
    for k in reversed(near):
        for column, description in lookalikes(re.sub(r"(^|\s)#.*", "", lines[k])):
            return f"; line {k + 1} has {description} in column {column + 1}"
    for k in reversed(near):
        if "\t" in lines[k][: len(lines[k]) - len(lines[k].lstrip())]:
            return f"; line {k + 1} begins with a tab: YAML is indented with spaces"
    return ""


def _too_deep() -> str:
    return f"is nested more than {MAX_DEPTH} levels deep"


def _deep_place(text: str) -> str:
    """Return `line:column` where a text is nested too deeply; reading events needs no recursion."""
    depth = 0
    for event in yaml.parse(text, Loader=_Loader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_DEPTH and event.start_mark:
            return f"{event.start_mark.line + 1}:{event.start_mark.column + 1}"
    return "1:1"


class _Builder:
    """Turns nodes into plain data and collects what is wrong with them."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.problems: list[Problem] = []
        self._seen: set[int] = set()
        self._open: set[int] = set()
        self._aliased = 0

    def build(self, node: yaml.Node, loc: Loc, aliased: int) -> Any:
        """Return the data of a node; `aliased` is the number of aliases on the way to it."""
        repeated = id(node) in self._seen
        self._seen.add(id(node))
        self._aliased += bool(aliased or repeated)
        if self._aliased > MAX_ALIASED_NODES:
            self._stop(node, loc, f"aliases repeat more than {MAX_ALIASED_NODES} parts; write them out")
        if id(node) in self._open:
            self._stop(node, loc, "an alias contains itself")
        if len(self._open) >= MAX_DEPTH:
            self._stop(node, (), _too_deep())
        self._open.add(id(node))
        data = self._content(node, loc, aliased + repeated)
        self._open.remove(id(node))
        return data

    def _content(self, node: yaml.Node, loc: Loc, aliased: int) -> Any:
        kind = node.tag.removeprefix("tag:yaml.org,2002:")
        if isinstance(node, yaml.MappingNode) and kind == "map":
            return self._mapping(node, loc, aliased)
        if isinstance(node, yaml.SequenceNode) and kind == "seq":
            return [self.build(item, (*loc, i), aliased) for i, item in enumerate(node.value)]
        if isinstance(node, yaml.ScalarNode) and kind in _SCALARS:
            try:
                return _SCALARS[kind](node.value)
            except ValueError as error:
                self._report(node, loc, f"is not a valid {kind}: {str(error).splitlines()[0]}")
                return None
        self._report(node, loc, f"the tag {node.tag} is not allowed: a scene is plain data")
        return None

    def _mapping(self, node: yaml.MappingNode, loc: Loc, aliased: int) -> dict[str, Any]:
        data: dict[str, Any] = {}
        lines: dict[str, int] = {}
        for key_node, value_node in node.value:
            if not isinstance(key_node, yaml.ScalarNode) or key_node.tag == "tag:yaml.org,2002:null":
                self._report(key_node, loc, "a key must be text")
                continue
            key = str(key_node.value)
            if fault := _fault_of_key(key_node):
                self._report(key_node, loc, fault)
                continue
            if key in data:
                first = f"the first is in line {lines[key]}"
                self._report(key_node, (*loc, key), f"this key is here twice; {first}; keep one")
            else:
                lines[key] = key_node.start_mark.line + 1
            data[key] = self.build(value_node, (*loc, key), aliased)
        return data

    def _report(self, node: yaml.Node, loc: Loc, message: str) -> None:
        mark = node.start_mark
        place = f"{self.name}:{mark.line + 1}:{mark.column + 1}"
        self.problems.append(Problem(place, ".".join(map(str, loc)), message))

    def _stop(self, node: yaml.Node, loc: Loc, message: str) -> None:
        self._report(node, loc, message)
        raise SceneError(self.problems)


def _fault_of_key(node: yaml.ScalarNode) -> str:
    """Return what is wrong with a key that means something else than it looks like, or an empty text."""
    if node.style is not None:  # quoted
        return ""
    if node.value == "<<":
        return "merge keys (`<<`) are not part of YAML 1.2: write the keys out, or repeat a whole part (`*name`)"
    for column, description in lookalikes(node.value):
        if instead_of(node.value[column]) in ("", " ", ":", ","):
            at = node.start_mark.column + column + 1
            return f"the key {shown(node.value)} has {description} in column {at}"
    return ""


def _int(text: str) -> int:
    if len(text) > MAX_DIGITS:
        raise ValueError(f"it has {len(text):,} digits")
    return int(text, 0) if text.startswith(("0o", "0x")) else int(text)


def _float(text: str) -> float:
    return float(
        text.replace(".", "", 1) if "n" in text.lower() else text
    )  # .inf, .nan: Python writes them without a dot


def _bool(text: str) -> bool:
    if text.lower() not in ("true", "false"):
        raise ValueError(f"'{text}' is neither true nor false")
    return text.lower() == "true"


_SCALARS: dict[str, Callable[[str], Any]]
_SCALARS = {"str": str, "int": _int, "float": _float, "bool": _bool, "null": lambda _: None}


def write(data: Any) -> str:
    """Return YAML text that `read` turns into the same plain data, with bit-for-bit identical floats."""
    text = yaml.dump(data, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=100, allow_unicode=True)
    return str(text)


def with_number(data: Any, loc: Sequence[int | str]) -> bool:
    """Replace a text such as `1.0e4` at a place in plain data by its number; return whether there is one.

    Data that PyYAML or another program has read from a scene's file has such numbers as text.
    """
    for key in loc[:-1]:
        try:
            data = data[key]
        except (KeyError, IndexError, TypeError):
            return False
    inside = data.get(loc[-1]) if isinstance(data, dict) and loc else None
    if isinstance(data, list) and loc and isinstance(loc[-1], int) and loc[-1] < len(data):
        inside = data[loc[-1]]
    if not (isinstance(inside, str) and _EXPONENT.fullmatch(inside)):
        return False
    data[loc[-1]] = _float(inside)
    return True
