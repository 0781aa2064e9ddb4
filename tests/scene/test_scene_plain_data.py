"""Numbers and texts that no scene can mean are refused with their place, wherever they are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from cqrun.errors import SceneError
from cqrun.scene.load import load_scene, resolve
from cqrun.scene.paths import with_values

Refused = Callable[..., list[str]]

SIZE = "must be 0, or from 1e-100 to 1e+30 in size, is "


@pytest.mark.parametrize(
    ("number", "message"),
    [
        ("1e308", f"{SIZE}1e+308"),
        ("-1e31", f"{SIZE}-1e+31"),
        ("1e-320", f"{SIZE}1e-320"),
        ("-1e-101", f"{SIZE}-1e-101"),
        ("1" + "0" * 300, "is a whole number of about 301 digits; the largest is 2^63 - 1 = 9223372036854775807"),
        (str(2**63), "is a whole number of about 19 digits; the largest is 2^63 - 1"),
    ],
)
@pytest.mark.parametrize("path", ["world.gravity.1", "bodies.beam.material.density", "seed", "data.truth.a"])
def test_impossible_numbers_are_refused_at_their_place(beam: str, path: str, number: str, message: str) -> None:
    with pytest.raises(SceneError) as info:
        load_scene(beam, [f"{path}={number}"])
    assert [(problem.path, message in problem.message) for problem in info.value.problems] == [(path, True)]


@pytest.mark.parametrize("number", ["1e30", "1e-100", "0", "-0.0", "6.123233995736766e-17"])
def test_possible_numbers_are_left_alone(beam: str, number: str) -> None:
    assert load_scene(beam, [f"world.gravity.0={number}"]).world.gravity[0] == float(number)


@pytest.mark.parametrize("value", [1e308, 2**64, 10**400, 10**5000], ids=["1e308", "2^64", "10^400", "10^5000"])
def test_values_given_in_python_are_looked_at_too(beam: str, value: Any) -> None:
    scene = load_scene(beam)
    with pytest.raises(SceneError, match=r"world.gravity.0: (must be 0, or from|is a whole number of about)"):
        with_values(scene, {"world.gravity.0": value})
    data = resolve(scene)
    data["world"]["gravity"] = [value, 0.0]
    with pytest.raises(SceneError, match=r"scene: world.gravity.0: (must be 0, or from|is a whole number of about)"):
        load_scene(data)


@pytest.mark.parametrize(
    ("character", "message"),
    [
        ("\\e[2J", r"has the control character U+001B as character 2 of 'a\x1b[2Jb': remove it"),
        ("\\n", r"has a line break as character 2 of 'a\nb': remove it"),
        ("\\u202e", r"has the control character U+202E as character 2"),
        ("\\ud83d", r"has the control character U+D83D as character 2 of 'a\ud83db'"),
    ],
)
@pytest.mark.parametrize("old", ["beam:", "tip:", "youngs_modulus:", "clamp:", "linear", "box: {corner: [0.05"])
def test_control_characters_in_keys_and_texts_are_refused_and_not_printed(
    refused: Refused, old: str, character: str, message: str
) -> None:
    text = f'"a{character}b"' + (old[old.index(":") :] if ":" in old else "")
    lines = refused("log", text) if old == "linear" else refused(old, text)
    assert any(message in line for line in lines), lines
    assert all(line.isprintable() and line.startswith("beam.yaml:") for line in lines)
