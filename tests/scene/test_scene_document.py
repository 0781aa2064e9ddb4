"""YAML 1.2 scalars, positions of mistakes, and harmful texts."""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
import pytest

from cqrun.errors import SceneError
from cqrun.scene.document import MAX_CHARACTERS, read, write


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e4", 1e4),
        ("1.5E-3", 1.5e-3),
        (".5", 0.5),
        ("1.", 1.0),
        ("-3", -3),
        ("+3", 3),
        ("010", 10),
        ("0x1F", 31),
        ("0o17", 15),
        ("1:30", "1:30"),
        ("no", "no"),
        ("on", "on"),
        ("y", "y"),
        ("TRUE", True),
        ("false", False),
        ("~", None),
        ("", None),
        ("Null", None),
        ("2001-01-01", "2001-01-01"),
        ("<<", "<<"),
        ("=", "="),
        ("1_000", "1_000"),
        ("'1e4'", "1e4"),
        ("-.inf", -math.inf),
        (".INF", math.inf),
    ],
)
def test_scalars_are_those_of_yaml_1_2(text: str, value: Any) -> None:
    read_value = read(f"a: {text}").data["a"]
    assert read_value == value
    assert type(read_value) is type(value)


def test_nan_is_read_so_that_the_schema_can_refuse_it_with_its_position() -> None:
    assert math.isnan(read("a: .nan").data["a"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: {b: 1}\nb: 2\n  \na: 3", "s.yaml:4:1: a: this key is here twice; the first is in line 1"),
        ("x:\n  a: 1\n  a: 1", "s.yaml:3:3: x.a: this key is here twice"),
        ("a: [1, 2\nb: 3", "s.yaml:2:2: this is not YAML: while parsing a flow sequence"),
        ("\ta: 1", "s.yaml:1:1: this is not YAML: "),
        ("a: 1\n---\nb: 2", "s.yaml:2:1: this is not YAML: expected a single document"),
        ("a: *nope", "s.yaml:1:4: this is not YAML: found undefined alias 'nope'"),
        ("a: 1\nb: \x07", "s.yaml:2:4: this is not YAML: the character U+0007 is not allowed: remove it"),
        ("", "s.yaml:1:1: is empty"),
        ("# only this\n", "s.yaml:1:1: is empty"),
        ("? [a]: 3", "a key must be text"),
        ("null: 3", "s.yaml:1:1: a key must be text"),
        ("a: !!int x", "s.yaml:1:4: a: is not a valid int"),
        ("a: !!bool maybe", "s.yaml:1:4: a: is not a valid bool"),
        ("a: " + "9" * 5000, "s.yaml:1:4: a: is not a valid int: it has 5,000 digits"),
        ("a: &x [1, *x]", "s.yaml:1:4: a.1: an alias contains itself"),
        ("a:\n " + "[" * 5000, "s.yaml:2:101: is nested more than 100 levels deep"),
        ("a: " + "[" * 150 + "]" * 150, "is nested more than 100 levels deep"),
        ("#" * (MAX_CHARACTERS + 1), "s.yaml:1:1: has 500001 characters; a scene has at most 500,000 characters: "),
    ],
)
def test_bad_texts_are_refused_with_their_position(text: str, message: str) -> None:
    with pytest.raises(SceneError) as info:
        read(text, "s.yaml")
    assert message in str(info.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: &x {b: 1}\nc:\n  <<: *x", "s.yaml:3:3: c: merge keys (`<<`) are not part of YAML 1.2: write the keys out"),
        (
            "a: {b:\u00a01}",
            "s.yaml:1:5: a: the key 'b:\\xa01' has a no-break space (U+00A0) instead of a space in column 7",
        ),
        ("a:\n\u00a0 b: 1\n  c: 2", "; line 2 has a no-break space (U+00A0) instead of a space in column 1"),
        ("a:\n\tb: 1\n", "; line 2 begins with a tab: YAML is indented with spaces"),
        ("a:\n  b: 1\n \tc: 1\n", "; line 3 begins with a tab: YAML is indented with spaces"),
        ("a\uff1a 1\nb: {c: 1}", "; line 1 has a fullwidth colon (U+FF1A) instead of : in column 2"),
        (
            "a\u200b: 1",
            "s.yaml:1:1: the key 'a\\u200b' has a zero width space (U+200B) that is not visible in column 2",
        ),
        ("a: \u201cb: c\u201d", '; line 1 has a left double quotation mark (U+201C) instead of " in column 4'),
    ],
)
def test_what_looks_like_something_else_is_named(text: str, message: str) -> None:
    with pytest.raises(SceneError) as info:
        read(text, "s.yaml")
    assert message in str(info.value)


@pytest.mark.parametrize("text", ["\u201cb\u201d", "b\u2014c # d\u00a0e", '"<<"', "\u7532\u3000", "caf\u00e9"])
def test_such_characters_in_texts_are_read(text: str) -> None:
    assert read(f"title: {text}\n'\u00a0': 1\n'<<': 2").data.keys() == {"title", "\u00a0", "<<"}


def test_the_cause_of_wrong_syntax_is_not_looked_for_in_comments_and_far_away() -> None:
    with pytest.raises(SceneError) as info:
        read("title: a\u2014b\n\nc: 1 # \u00a0\nd: {\n", "s.yaml")
    assert "U+" not in str(info.value)


@pytest.mark.parametrize(
    "tag",
    [
        "!!python/object/apply:os.system [ls]",
        "!!python/name:os.system",
        "!mine {a: 1}",
        "!!set {a}",
        "!!binary YQ==",
    ],
)
def test_tags_are_refused(tag: str) -> None:
    with pytest.raises(SceneError, match=r"s.yaml:1:4: a: the tag .* is not allowed: a scene is plain data"):
        read(f"a: {tag}", "s.yaml")


def test_an_alias_may_repeat_a_part_but_a_bomb_is_refused() -> None:
    assert read("a: &x {b: [1, 2]}\nc: *x").data["c"] == {"b": [1, 2]}
    rows = ["a0: &a0 [" + "1," * 10 + "]"]
    rows += [f"a{i}: &a{i} [" + f"*a{i - 1}," * 10 + "]" for i in range(1, 10)]
    with pytest.raises(SceneError, match=r"s.yaml:1:\d+: .* aliases repeat more than 100000 parts"):
        read("\n".join(rows), "s.yaml")


def test_all_duplicates_are_reported_at_once() -> None:
    with pytest.raises(SceneError) as info:
        read("a: 1\na: 2\nb: 1\nb: 2", "s.yaml")
    assert [p.where for p in info.value.problems] == ["s.yaml:2:1", "s.yaml:4:1"]


def test_floats_survive_to_the_bit(rng: np.random.Generator) -> None:
    bits = rng.integers(0, 0x7FE0000000000000, 2000)
    floats = [struct.unpack("<d", struct.pack("<q", int(b)))[0] for b in bits] + [5e-324, -0.0, 1e16, 1e22]
    back = read(write({"x": floats})).data["x"]
    assert [struct.pack("<d", x) for x in back] == [struct.pack("<d", x) for x in floats]


def test_texts_that_look_like_something_else_survive() -> None:
    texts = [
        "1e4",
        "no",
        "1:30",
        "010",
        "~",
        "",
        "null",
        ".inf",
        "0x1",
        "true",
        "a: b",
        "- x",
        "é",
        "2001-01-01",
        "=",
        "two\nlines",
        " lead",
        "#c",
        "1.",
        "a\tb",
        "*x",
        "&x",
        "!x",
        "'",
        '"',
    ]
    data = {"texts": texts, "keys": {text: [{"a": 1}] for text in texts if text != ""}}
    assert read(write(data)).data == data


def test_positions_of_keys_values_and_missing_parts() -> None:
    document = read("a:\n  b: [1,  2]\n  c: {d: 3}\n", "s.yaml")
    assert document.where(("a", "b", 1)) == "s.yaml:2:11"
    assert document.where(("a", "c", "d")) == "s.yaml:3:10"
    assert document.where(("a", "c", "d"), at_key=True) == "s.yaml:3:7"
    assert document.where(("a", "c")) == "s.yaml:3:3"
    assert document.where(("a", "nothing", "here")) == "s.yaml:1:1"
