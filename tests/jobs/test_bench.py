"""How long passes take: every pass has its line, shares add up, and what is measured is the scene's own rollout."""

from __future__ import annotations

import json

import numpy as np
import pytest
from small_beam import BEAM, Listener
from small_finger import FINGER, written

from cqrun.build.model import build
from cqrun.engine.frames import make_rollout
from cqrun.errors import RunError, SceneError, Stopped, UsageError
from cqrun.jobs import bench
from cqrun.jobs.bench import excerpt_of, excerpt_of_block, run_bench, run_bench_scene, shares
from cqrun.learning.acting import make_agent
from cqrun.running.reporter import Silent
from cqrun.scene.load import load_scene

PASSES = {
    "momentum", "sort", "clear", "scatter", "update_grid", "move", "move_vjp", "clear_both", "scatter_both",
    "update_grid_vjp", "friction_vjp", "momentum_vjp",
}  # fmt: skip
ACTING = PASSES | {"policy", "policy_vjp", "activate", "activate_vjp", "record", "record_vjp"}
PULLING = ACTING - {"activate", "activate_vjp"} | {"forces", "forces_vjp"}
CHAINED = PASSES | {"move_momentum", "momentum_move_vjp"}
PUSHED = FINGER.replace(
    "muscle: {muscle: {body: finger, each: [left, right], axis: [0, 1], strength: 4}}",
    "push: {body_force: {body: finger, direction: [1, 0], acceleration: 0.1}}",
)
PULLED = PUSHED.replace(
    "push: {body_force: {body: finger, direction: [1, 0], acceleration: 0.1}}",
    "pull: {cable: {body: finger, route: [[0.41, 0.25], [0.41, 0.55]], stiffness: 1}}",
)


@pytest.fixture(autouse=True)
def few(monkeypatch):
    """Measure each pass twice."""
    monkeypatch.setattr(bench, "REPEAT", 1)
    monkeypatch.setattr(bench, "COPIED", 1 << 20)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "passes"), [(BEAM, PASSES), (BEAM, CHAINED), (FINGER, ACTING), (PUSHED, ACTING), (PULLED, PULLING)]
)
def test_every_pass_has_a_line_and_a_share(tmp_path, text, passes, monkeypatch):
    if passes is CHAINED:
        monkeypatch.setattr("cqrun.engine.updated.rollout.CHAINED_FROM", 0)
    file = tmp_path / "scene.yaml"
    file.write_text(text)
    output = tmp_path / "new" / "bench.json"
    lines = run_bench_scene(file, (), output, threads=1, talk=Silent())
    told = json.loads(output.read_text())
    assert set(told["passes"]) == passes
    assert all(np.isfinite(ns) and ns > 0.0 for ns in told["passes"].values())
    for whole in ("forward", "backward"):
        own = list(shares(told, whole))
        assert sum(s.share for s in own) == pytest.approx(1.0)
        assert sum(s.nanoseconds for s in own) == pytest.approx(told[whole])
    forward, backward = ({s.name for s in shares(told, whole)} for whole in ("forward", "backward"))
    assert forward | backward == passes | {"the rest"}
    # what a substep's adjoint does again of the substep
    assert forward & backward - {"the rest"} == {"momentum", "sort", "forces"} & passes
    for name in passes:
        assert any(line.startswith(f"  {name} ") for line in lines)
    particle_steps = 1e-9 * told["particles"] * told["substeps"]
    assert told["recompute"] == 1.0
    assert 0.01 < told["memory_GB_per_s"] < 10_000.0
    assert f"memory copied by 1 thread: {told['memory_GB_per_s']:.3g} GB/s, read and written" in lines
    assert told["seconds"] == pytest.approx({
        "forward": particle_steps * told["forward"],
        "gradient": particle_steps * (told["store"] + told["backward"]),
    })  # fmt: skip
    assert lines[-1] == f"written: {output}"


@pytest.mark.parametrize("text", [BEAM, FINGER.replace("duration: 0.1", "duration: 0.2")])
def test_what_is_measured_is_the_scenes_own_rollout(text):
    built = build(load_scene(text))
    excerpt = excerpt_of(built, 1, Silent())
    excerpt.measure(1)
    agent, model = make_agent(built, None, Silent()), built.model
    if agent is None:
        whole = make_rollout(model, built.assembly.inputs({}))
    else:
        whole = agent.rollout(agent.acting, agent.goals_in_the_middle, 1)
    states = whole.start[None].copy()
    whole.advance(0, excerpt.begin, states, keep=False)
    assert excerpt.begin > 0
    assert np.array_equal(excerpt.states[0], states[0])
    whole.advance(excerpt.begin, excerpt.end, states, keep=False)
    excerpt.rewind()
    excerpt.store()
    assert np.array_equal(excerpt.states[-1], states[0])


@pytest.mark.slow
def test_blocks(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench, "SIZES", ((2, 6),))
    monkeypatch.setattr(bench, "CORNERS_LIMIT", 4)
    output = tmp_path / "bench.json"
    told = run_bench(output, threads=1)
    assert json.loads(output.read_text()) == told
    assert [(row["particles"], row["precision"], row["threads"]) for row in told["rows"]] == [
        (36, "float64", 1), (36, "float32", 1),
    ]  # fmt: skip
    assert all(set(row["passes"]) == PASSES | {"record", "record_vjp"} for row in told["rows"])
    assert excerpt_of_block(2, 6, np.float64, 1).n == 36
    assert list(told["memory_GB_per_s"]) == ["1"]
    assert str(output) in capsys.readouterr().out


def test_what_goes_wrong_is_told(tmp_path):
    file = written(tmp_path)
    with pytest.raises(UsageError, match=r"is a folder|directory"):
        run_bench_scene(file, (), tmp_path, threads=1, talk=Silent())
    with pytest.raises(SceneError, match="memory"):
        run_bench_scene(file, ["memory=1KiB"], None, threads=1, talk=Silent())
    with pytest.raises(RunError, match=r"finger\.yaml: body"):
        run_bench_scene(file, ["world.gravity=[0, 1e6]"], None, threads=1, talk=Silent())
    with pytest.raises(Stopped, match="before anything was measured"):
        run_bench_scene(file, ["time.duration=1"], None, threads=1, talk=Listener(stop_after=1))
