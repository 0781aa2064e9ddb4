"""Results on disk: they are read back unchanged, and the error for a damaged or foreign file names the wrong key."""

from __future__ import annotations

import json
from typing import Any

import pytest
from pydantic import ValidationError

from cqrun.errors import UsageError
from cqrun.store.result import (
    AtBounds,
    BodyMotion,
    ConstraintValue,
    Designed,
    Direction,
    Episode,
    GradcheckResult,
    Identified,
    LearnedResult,
    LostEpisode,
    RecordingError,
    SimulateResult,
    Stage,
    SysidResult,
    read_result,
    require_result,
    values_in,
    write_result,
)
from cqrun.store.thinnest import Thinnest

E = "bodies.beam.material.elastic.fixed_corotated.youngs_modulus"
SHEAR = "bodies.beam.material.viscosity.shear"

SYSID = SysidResult(
    status="converged",
    message="small enough",
    loss=1.0 / 3.0,
    iterations=7,
    unknowns={
        E: Identified(initial=3e4, value=4.1e4, interval=(4e4, 4.2e4)),
        SHEAR: Identified(initial=[3.0, 3.0], value=[5.0, 6.0], interval=[(4.0, 6.0), None], reason="at a bound"),
    },
    recordings={
        "one": RecordingError(holdout=False, rmse_mm=0.1, markers_mm={"tip": 0.1, "root": None}),
        "two": RecordingError(holdout=True, rmse_mm=None, alignment_mm={"tip": 0.3}),
    },
    fracture={"beam": 0},
    findings=["a finding"],
)
STAGE = Stage(
    loss=0.5, terms={"tip": 0.5}, episodes=[Episode(goals={"target": [0.1, 0.2]}, loss=0.5, terms={"tip": 0.5})]
)
CODESIGN = LearnedResult(
    job="codesign",
    status="infeasible",
    message="not met",
    loss=None,
    iterations=3,
    unknowns={E: Designed(initial=[1.0, 1.0], value=[2.0, 1.0], at_bounds=AtBounds(lower=0, upper=1))},
    start=STAGE,
    trained=STAGE,
    constraints={"up": ConstraintValue(at_least=0.3, value=0.2, violation=0.1, start=0.25)},
    blew_up={"unseen": [LostEpisode(goals={"target": [0.3, 0.4]}, message="left the grid")]},
)
SIMULATE = SimulateResult(
    status="done",
    message="0.1 s simulated",
    time=0.1,
    bodies={"beam": BodyMotion(centroid=[0.1, 0.2], kinetic_energy=1e-9, fastest=0.3, least_volume_ratio=0.9)},
    fracture={"beam": 0},
    findings=[],
    thinnest={"beam": Thinnest(thickness=0.01, cells=1.0, particles=2.0)},
)
GRADCHECK = GradcheckResult(
    agrees=False,
    loss=2.0,
    of="the loss",
    steps=[1e-2, 2.5e-3],
    rows=[
        Direction(
            block=E, count=1, adjoint=1.0, differences=None, error=None, step=1e-2, noise=0.0, scan=[None],
            verdict="disagrees", agrees=False,
        )
    ],
)  # fmt: skip
ALL = [SYSID, CODESIGN, SIMULATE, GRADCHECK]


@pytest.mark.parametrize("result", ALL, ids=lambda result: result.job)
def test_what_is_written_comes_back(tmp_path, result):
    assert read_result(tmp_path) is None
    write_result(tmp_path, result)
    assert read_result(tmp_path) == result
    assert require_result(tmp_path, type(result)) == result


def test_keys_that_say_nothing_are_missing_and_the_others_have_their_order(tmp_path):
    write_result(tmp_path, SYSID)
    found = json.loads((tmp_path / "result.json").read_text())
    assert list(found) == [
        "job", "status", "message", "loss", "iterations", "unknowns", "recordings", "fracture", "findings",
    ]  # fmt: skip
    assert list(found["unknowns"][E]) == ["initial", "value", "interval"]
    assert found["unknowns"][SHEAR] == {
        "initial": [3.0, 3.0], "value": [5.0, 6.0], "interval": [[4.0, 6.0], None], "reason": "at a bound",
    }  # fmt: skip
    assert list(found["recordings"]["two"]) == ["holdout", "rmse_mm", "alignment_mm"]
    write_result(tmp_path, CODESIGN)
    found = json.loads((tmp_path / "result.json").read_text())
    assert (found["loss"], found["unseen"]) == (None, None)
    assert list(found["constraints"]["up"]) == ["at_least", "value", "violation", "start"]
    write_result(tmp_path, SIMULATE)
    assert "goals" not in json.loads((tmp_path / "result.json").read_text())


def test_a_number_that_is_none_is_not_written(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        write_result(tmp_path, SYSID.model_copy(update={"loss": float("nan")}))
    assert not list(tmp_path.iterdir())


def test_a_misspelt_key_and_text_for_a_number_are_errors():
    with pytest.raises(ValidationError, match="vale"):
        Identified(initial=1.0, vale=2.0)
    with pytest.raises(ValidationError, match="number"):
        Identified(initial=1.0, value="2.0")


def changed(**changes: Any) -> dict[str, Any]:
    """Return the identification as plain data with other values at some of its keys."""
    return json.loads(json.dumps(SYSID.model_dump() | changes))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "unreadable (EOF while parsing an object at line 1 column 1)"),
        ([], "is not a result: it must be a mapping with the key `job`"),
        ({"loss": 1.0}, "is not a result: it must be a mapping with the key `job`"),
        (
            changed(job="fit"),
            "job: must be one of 'sysid', 'control', 'codesign', 'simulate', 'rest', 'gradcheck', is 'fit'",
        ),
        (changed(iterations=2.5), "iterations: must be a whole number, is 2.5"),
        (changed(los=1.0), "los: unknown key"),
        (changed(unknowns={E: {"initial": 1.0}}), f"unknowns.{E}.value: is missing"),
        (changed(unknowns={E: {"initial": 1.0, "value": "soft"}}), f"unknowns.{E}.value: must be a number, is 'soft'"),
        (changed(unknowns={E: {"initial": [1.0], "value": [1.0], "interval": [[1.0]]}}), f"unknowns.{E}.interval"),
        (changed(findings=[1]), "findings.0: must be text, is 1"),
        ({"job": "sysid"}, "status: is missing"),
    ],
)
def test_a_damaged_or_foreign_file_is_told_with_its_key(tmp_path, content, message):
    (tmp_path / "result.json").write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(UsageError) as error:
        read_result(tmp_path)
    assert str(error.value).startswith(f"{tmp_path / 'result.json'}: {message}")
    assert str(error.value).endswith("; run the scene again with --fresh")


def test_a_result_of_another_job_is_refused(tmp_path):
    write_result(tmp_path, SYSID)
    with pytest.raises(UsageError, match="has no result of control or codesign"):
        require_result(tmp_path, LearnedResult)


def test_values_and_numbers_of_unknowns():
    assert values_in(SYSID) == {E: 4.1e4, SHEAR: [5.0, 6.0]}
    assert values_in(CODESIGN) == {E: [2.0, 1.0]}
    assert values_in(SIMULATE) == values_in(None) == {}
    assert SYSID.unknowns[E].numbers() == ([4.1e4], [(4e4, 4.2e4)], [3e4])
    assert SYSID.unknowns[SHEAR].numbers() == ([5.0, 6.0], [(4.0, 6.0), None], [3.0, 3.0])
    assert Identified(initial=[1.0, 1.0], value=[2.0, 3.0]).numbers()[1] == [None, None]
    assert list(CODESIGN.stages()) == ["start", "trained"]
