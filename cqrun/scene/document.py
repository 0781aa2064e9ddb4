"""YAML text -> plain data that remembers where each part stood; plain data -> YAML text.

Numbers, booleans and nothing else are read as YAML 1.2's core schema has them: `1e4` is a number, `no`, `on`
and `1:30` are text, `010` is ten. Tags are refused, so no text can build an object or run code; aliases
may repeat a part, but not blow it up.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import yaml

from cqrun.errors import Problem, SceneError
from cqrun.explain import Loc

MAX_CHARACTERS = 4_000_000
MAX_ALIASED_NODES = 100_000
MAX_DEPTH = 100

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


class _Loader(yaml.SafeLoader):
    """Reads text as nodes; `_Builder` makes data of them."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012 (PyYAML's own way)


class _Dumper(yaml.SafeDumper):
    """Writes plain data such that `_Loader` reads the same data: quotes follow the same resolvers."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012

    def ignore_aliases(self, data: Any) -> bool:
        return True


for _name, _pattern, _first in _RESOLVERS:
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(f"tag:yaml.org,2002:{_name}", re.compile(rf"(?:{_pattern})\Z"), _first)


@dataclass(frozen=True)
class Document:
    """Plain data and, where it came from text, the nodes it was made of.

    `name` is the file's name as the user typed it, or `scene` for data that had no file.
    """

    data: Any
    name: str = "scene"
    node: yaml.Node | None = field(default=None, repr=False)

    def where(self, loc: Loc, *, at_key: bool = False) -> str:
        """Return `file:line:column` of a place, or of the nearest part around it that the text has.

        Args:
            loc: keys and indices from the root.
            at_key: point at the last key even if its value is a scalar.
        """
        line, column = self.position(loc, at_key=at_key)
        return f"{self.name}:{line}:{column}" if self.node is not None else self.name

    def leads_on(self, loc: Loc) -> bool:
        """Say whether the text has a mapping or a list at this very place."""
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
        """Return line and column, counted from 1, as `where` does."""
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
    """Return where a key stands and the node it leads to."""
    if isinstance(node, yaml.MappingNode):
        for key_node, value in node.value:
            if isinstance(key_node, yaml.ScalarNode) and key_node.value == str(key):
                return key_node.start_mark, value
    if isinstance(node, yaml.SequenceNode) and isinstance(key, int) and 0 <= key < len(node.value):
        return node.value[key].start_mark, node.value[key]
    return None


def _is_shorthand(node: yaml.Node, rest: Loc) -> bool:
    """Say whether a list stands for `{shapes: [...]}`, so that the key has no text of its own."""
    return isinstance(node, yaml.SequenceNode) and len(rest) > 1 and isinstance(rest[1], int)


def read(text: str, name: str = "scene") -> Document:
    """Return the document in a YAML text.

    Raises:
        SceneError: syntax, duplicate keys, tags, aliases that grow too large; with `name:line:column`.
    """
    if len(text) > MAX_CHARACTERS:
        message = f"has {len(text)} characters; a scene has at most {MAX_CHARACTERS}"
        raise SceneError([Problem(f"{name}:1:1", "", message)])
    try:
        node = yaml.compose(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f"{name}:{mark.line + 1}:{mark.column + 1}" if mark else name
        told = ", ".join(part for part in (error.context, error.problem) if part)
        raise SceneError([Problem(place, "", f"this is not YAML: {told}")]) from None
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        column = error.position - text.rfind("\n", 0, error.position)
        message = f"this is not YAML: the character {error.character!r} is not allowed"
        raise SceneError([Problem(f"{name}:{line}:{column}", "", message)]) from None
    except RecursionError:
        raise SceneError([Problem(f"{name}:{_deep_place(text)}", "", _too_deep())]) from None
    if node is None:
        raise SceneError([Problem(f"{name}:1:1", "", "is empty; a scene begins with `cqrun: 1`")])
    builder = _Builder(name)
    data = builder.build(node, (), 0)
    if builder.problems:
        raise SceneError(builder.problems)
    return Document(data, name, node)


def _too_deep() -> str:
    return f"is nested more than {MAX_DEPTH} levels deep"


def _deep_place(text: str) -> str:
    """Return `line:column` where a text is nested too deeply; its events come one by one, without recursion."""
    depth = 0
    for event in yaml.parse(text, Loader=_Loader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_DEPTH and event.start_mark:
            return f"{event.start_mark.line + 1}:{event.start_mark.column + 1}"
    return "1:1"


class _Builder:
    """Makes plain data of nodes, and collects what is wrong with them."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.problems: list[Problem] = []
        self._seen: set[int] = set()
        self._open: set[int] = set()
        self._aliased = 0

    def build(self, node: yaml.Node, loc: Loc, aliased: int) -> Any:
        """Return the data of a node; `aliased` says how many aliases led to it."""
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
                self._report(node, loc, f"is no {kind}: {str(error).splitlines()[0]}")
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
            if key in data:
                first = f"the first stands in line {lines[key]}"
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


def _int(text: str) -> int:
    return int(text, 0) if text.startswith(("0o", "0x")) else int(text)


def _float(text: str) -> float:
    return float(text.replace(".", "", 1) if "n" in text.lower() else text)  # .inf, .nan: Python has no dot


def _bool(text: str) -> bool:
    if text.lower() not in ("true", "false"):
        raise ValueError(f"'{text}' is neither true nor false")
    return text.lower() == "true"


_SCALARS: dict[str, Callable[[str], Any]]
_SCALARS = {"str": str, "int": _int, "float": _float, "bool": _bool, "null": lambda _: None}


def write(data: Any) -> str:
    """Return YAML text that `read` turns into the same plain data, floats to the bit."""
    text = yaml.dump(data, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=100, allow_unicode=True)
    return str(text)
