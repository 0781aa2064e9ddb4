"""Types say what a field means, however deep it holds the value; every field of the package has its type."""

from __future__ import annotations

from typing import Annotated, Any, Literal, get_args, get_origin

import pytest

from cqrun.plugin import reference
from cqrun.plugin.contract import Spec
from cqrun.plugin.reference import (
    ActuatorName,
    BodyName,
    FileName,
    GoalName,
    GroupName,
    InWorld,
    NamesActuator,
    NamesBody,
    NamesFile,
    NamesGoal,
    NamesGroup,
    Position,
    body_of,
    field_types,
    marked_in,
)
from cqrun.plugin.registry import FOLDERS, plugins


class Inner(Spec):
    """A part of its own."""

    carrier: BodyName


class Sensor(Spec):
    """Fields of every form."""

    carrier: BodyName
    other: BodyName | None = None
    hold: list[GroupName] | Literal["all"] = "all"
    facing: Annotated[str, NamesGroup(of="other")] | None = None
    drives: dict[ActuatorName, list[float]] | None = None
    files: dict[str, FileName] | None = None
    nested: list[dict[str, GoalName]] | None = None
    middle: Position | None = None
    route: list[Annotated[list[float], InWorld(first=1)]] | None = None
    inner: Inner | None = None
    label: str = ""


def found(kind: type[Any], **fields: Any) -> list[tuple[Any, Any, bool]]:
    """Return place, value and whether it is a key, of what the type of a sensor's fields marks."""
    return [(item.loc, item.value, item.at_key) for item in marked_in(Sensor(carrier="arm", **fields), kind)]


def test_a_value_is_found_by_its_type_wherever_it_stands():
    assert found(NamesBody) == [(("carrier",), "arm", False)]
    assert found(NamesGroup, hold=["tip", "root"]) == [(("hold", 0), "tip", False), (("hold", 1), "root", False)]
    assert found(NamesActuator, drives={"left": [1.0]}) == [(("drives", "left"), "left", True)]
    assert found(NamesFile, files={"a": "a.csv"}) == [(("files", "a"), "a.csv", False)]
    assert found(NamesGoal, nested=[{}, {"x": "target"}]) == [(("nested", 1, "x"), "target", False)]


def test_a_word_of_its_own_is_no_name():
    assert found(NamesGroup, hold="all") == []
    assert found(NamesGroup, hold=["all"]) == [(("hold", 0), "all", False)]


def test_a_part_inside_answers_for_itself():
    sensor = Sensor(carrier="arm", inner=Inner(carrier="leg"), label="arm")
    assert [item.value for item in marked_in(sensor, NamesBody)] == ["arm"]
    assert sensor.inner is not None
    assert [item.part for item in marked_in(sensor.inner, NamesBody)] == [sensor.inner]


def test_a_mark_tells_more_than_its_kind():
    sensor = Sensor(carrier="arm", other="leg", facing="toe", middle=[1.0, 2.0], route=[[0.5, 1.0, 2.0]])
    assert [(item.value, item.mark.of) for item in marked_in(sensor, NamesGroup)] == [("toe", "other")]
    assert [(item.loc, item.mark.first) for item in marked_in(sensor, InWorld)] == [(("middle",), 0), (("route", 0), 1)]


def test_a_part_is_of_the_body_that_its_first_body_field_names():
    assert body_of(Sensor(carrier="arm", other="leg")) == "arm"
    assert body_of(Inner(carrier="leg")) == "leg"

    class Anywhere(Spec):
        on: BodyName | None = None
        towards: BodyName = "leg"

    class Several(Spec):
        on: list[BodyName]

    assert body_of(Anywhere()) is None
    assert body_of(Several(on=["arm", "leg"])) is None


def test_marks_change_nothing_that_an_editor_is_told():
    class Plain(Spec):
        carrier: str
        middle: list[float]

    class Marked(Spec):
        carrier: BodyName
        middle: Position

    assert Marked.model_json_schema()["properties"] == Plain.model_json_schema()["properties"]


PLAIN_TEXT = {
    ("image", "colours"), ("image", "background"), ("colour", "colour"),
    ("nearest_marker", "markers"), ("nearest_marker", "marker"),
    ("poses", "markers"), *((kind, field) for kind in ("poses", "force", "moment") for field in ("loads", "ignore")),
    *((kind, field) for kind in ("force", "moment") for field in ("column", "time")),
    ("measured", "component"), ("chamber", "each"), ("chamber_pressure", "part"), ("chamber_volume", "part"),
}  # fmt: skip
"""Fields of plug-ins of the package that hold text and refer to no other part of the scene, and to no file."""


def holds_plain_text(annotation: Any) -> bool:
    """Say whether a type holds text whose meaning no mark tells."""
    args = get_args(annotation)
    if get_origin(annotation) is Annotated:
        marked = args[0] is str and any(type(mark).__module__ == reference.__name__ for mark in args[1:])
        return not marked and holds_plain_text(args[0])
    return annotation is str or (get_origin(annotation) is not Literal and any(map(holds_plain_text, args)))


@pytest.mark.parametrize("kind", FOLDERS)
def test_every_field_of_the_package_that_holds_a_name_says_of_what_by_its_type(kind):
    for name, cls in plugins(kind).items():
        text = [field for field, annotation in field_types(cls).items() if holds_plain_text(annotation)]
        assert {(name, field) for field in text} <= PLAIN_TEXT
