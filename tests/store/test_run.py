"""The run directory: its name, its status, and its lock."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from cqrun.errors import RunError, Stopped, UsageError
from cqrun.fingerprint import engine_hash
from cqrun.store.folder import FIGURES, make_below
from cqrun.store.result import SysidResult, read_result, write_result
from cqrun.store.run import RunDirectory, read_record
from cqrun.store.run_scene import RunScene, stem_of

ROOT = Path(__file__).parents[2]
FOUND = SysidResult(status="converged", message="small enough", loss=1.0, iterations=3, unknowns={})


@pytest.fixture
def scene(tmp_path):
    data = tmp_path / "data.csv"
    data.write_text("time,marker\n")
    return RunScene("beam", "cqrun: 1\nseed: 0\n", "cqrun: 1  # mine\n", {"data.csv": data})


@pytest.mark.parametrize(
    ("file", "stem"),
    [("a/beam.yaml", "beam"), ("...yaml", "...yaml"), ("..yaml", "..yaml"), (".yaml", ".yaml"), ("a.b.yaml", "a.b")],
)
def test_the_name_of_a_scene_is_a_folder_inside_the_results(file, stem):
    assert stem_of(Path(file)) == stem


def start(scene, out, **options):
    return RunDirectory.open(
        scene,
        out,
        **({"argv": ["cqrun", "sysid", "beam.yaml"], "seed": 5, "threads": 2} | options),
    )


def test_a_new_run_records_its_provenance(scene, tmp_path):
    with start(scene, tmp_path / "out") as run:
        assert run.path == tmp_path / "out" / "beam" / scene.digest()
        assert run.status == "new"
        run.begin()
        run.log("sampling")
    record = read_record(run.path)
    assert record["engine"] == engine_hash()
    assert record["versions"].keys() == {"cqrun", "python", "numba", "numpy", "scipy"}
    assert (record["job"], record["seed"], record["threads"]) == ("sysid", 5, 2)
    assert record["argv"] == ["cqrun", "sysid", "beam.yaml"]
    assert "git" in record
    assert (run.path / "scene.yaml").read_text() == scene.resolved == run.resolved
    assert (run.path / "scene.original.yaml").read_text() == scene.original
    assert "s] sampling\n" in (run.path / "log.txt").read_text()


@pytest.fixture
def scene_with_plugin(tmp_path):
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "law.py").write_text("E = 1\n")
    names = {"own/law.py": tmp_path / "own" / "law.py"}
    return RunScene("beam", "cqrun: 1\nplugins: [own/law.py]\n", "", plugins=names)


def test_a_run_keeps_its_plug_ins_and_its_name_depends_on_them(scene_with_plugin, tmp_path):
    with start(scene_with_plugin, tmp_path / "out") as run:
        run.begin()
    copy, original = run.path / "plugins" / "law.py", tmp_path / "own" / "law.py"
    assert copy.read_text() == "E = 1\n"
    original.write_text("E = 2\n")
    assert scene_with_plugin.digest() != run.path.name
    assert copy.read_text() == "E = 1\n"
    with RunDirectory.resume(run.path) as again:  # it uses the copy
        assert again.status == "running"


@pytest.mark.parametrize("spoil", [lambda copy: copy.write_text("E = 3\n"), lambda copy: copy.unlink()])
def test_a_changed_copy_of_a_plug_in_is_not_run(scene_with_plugin, tmp_path, spoil):
    with start(scene_with_plugin, tmp_path / "out") as run:
        run.begin()
    spoil(run.path / "plugins" / "law.py")
    with pytest.raises(UsageError, match=r"law.py: this copy of a plug-in has changed since the run began"):
        RunDirectory.resume(run.path)
    with pytest.raises(UsageError, match="has changed"):
        start(scene_with_plugin, tmp_path / "out")
    with start(scene_with_plugin, tmp_path / "out", fresh=True) as fresh:
        assert (fresh.path / "plugins" / "law.py").read_text() == "E = 1\n"


def test_its_name_depends_on_the_resolved_scene_and_the_contents_of_its_files(scene):
    name = scene.digest()
    assert len(name) == 12
    assert RunScene("beam", scene.resolved, "other comments", scene.files).digest() == name
    assert RunScene("beam", "cqrun: 1\nseed: 1\n", scene.original, scene.files).digest() != name
    assert RunScene("beam", scene.resolved, scene.original, scene.files, job="simulate").digest() != name
    scene.files["data.csv"].write_text("time,marker,x\n")
    assert scene.digest() != name
    scene.files["data.csv"].unlink()
    with pytest.raises(UsageError, match=r"data.csv: cannot be read"):
        scene.digest()


def test_running_again_continues_and_a_finished_run_is_recognised(scene, tmp_path):
    with start(scene, tmp_path) as run:
        run.begin()
        run.history(["loss"]).record(0, {"loss": 1.0}, seconds=100.0)
    with start(scene, tmp_path) as run:  # as after a kill
        assert (run.status, run.finished) == ("running", False)
        run.history(["loss"])
        assert run.elapsed() >= 100.0
        write_result(run.path, FOUND)
        run.finish("converged", "small enough")
    with RunDirectory.resume(run.path) as run:
        assert run.finished
        assert run.record["reason"] == "small enough"
        assert run.record["seconds"] >= 100.0
        assert read_result(run.path) == FOUND


def test_temporary_files_of_a_killed_process_are_removed(scene, tmp_path):
    with start(scene, tmp_path) as run:
        run.begin()
    (run.path / ".result.json.4711.tmp").write_text('{"loss": ')
    with RunDirectory.resume(run.path):
        assert not list(run.path.glob(".*"))


def test_extending_a_finished_run_keeps_its_name(scene, tmp_path):
    with start(scene, tmp_path) as run:
        run.finish("iteration_limit", "30 iterations")
        path = run.path
    with RunDirectory.resume(path) as run:
        run.extend("cqrun: 1\nmore: 1\n", ["cqrun", "resume", "-o", "x=1"])
        assert run.status == "running"
    with RunDirectory.resume(path) as run:
        assert run.resolved == "cqrun: 1\nmore: 1\n"
        assert run.record["extended"] == [["cqrun", "resume", "-o", "x=1"]]
    with start(scene, tmp_path) as run:
        assert run.path == path


def test_fresh_starts_over(scene, tmp_path):
    with start(scene, tmp_path) as run:
        run.finish("converged", "")
        write_result(run.path, FOUND)
        (make_below(run.path, FIGURES) / "convergence.png").write_text("")
        run.replay_log()
    with start(scene, tmp_path, fresh=True) as run:
        assert run.status == "new"
        assert sorted(p.name for p in run.path.iterdir()) == [
            "lock",
            "run.json",
            "scene.original.yaml",
            "scene.yaml",
        ]


def test_a_run_killed_while_it_was_created_starts_over(scene, tmp_path):
    with start(scene, tmp_path) as run:
        run.replay_log()
    (run.path / "run.json").unlink()
    with start(scene, tmp_path) as run:
        assert run.status == "new"
        assert not (run.path / "evals.log").exists()


@pytest.mark.parametrize(
    ("error", "expected"),
    [(Stopped("SIGTERM"), "stopped"), (RunError("disk full"), "stopped"), (KeyboardInterrupt(), "stopped")],
)
def test_an_error_leaves_a_run_that_can_be_resumed(scene, tmp_path, error, expected):
    def fail():
        with start(scene, tmp_path) as run:
            run.begin()
            raise error

    with pytest.raises(type(error)):
        fail()
    with start(scene, tmp_path) as run:
        assert run.status == expected
        assert type(error).__name__ in run.record["reason"]


def test_an_unknown_final_status_is_refused(scene, tmp_path):
    with start(scene, tmp_path) as run, pytest.raises(ValueError, match="perfect"):
        run.finish("perfect", "")


def test_a_run_of_another_engine_is_refused_with_advice(scene, tmp_path):
    with start(scene, tmp_path) as run:
        run.finish("converged", "")
    record = read_record(run.path) | {"engine": "0123456789ab"}
    (run.path / "run.json").write_text(json.dumps(record))
    for take_up in (lambda: start(scene, tmp_path), lambda: RunDirectory.resume(run.path)):
        with pytest.raises(UsageError, match=r"another engine .*0123456789ab.*--fresh.*--out DIR"):
            take_up()
    with start(scene, tmp_path, fresh=True) as run:  # as advised; and the lock was released
        assert run.status == "new"


def test_resume_refuses_a_directory_that_is_not_a_run(scene, tmp_path):
    with pytest.raises(UsageError, match=r"nowhere: no run \(it has no run.json\)"):
        RunDirectory.resume(tmp_path / "nowhere")
    with start(scene, tmp_path) as run:
        pass
    with pytest.raises(UsageError, match=f"it holds runs: .*{scene.digest()}"):
        RunDirectory.resume(run.path.parent)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"status": "new"}'])
def test_an_unreadable_record_is_refused(scene, tmp_path, text):
    with start(scene, tmp_path) as run:
        pass
    (run.path / "run.json").write_text(text)
    with pytest.raises(UsageError, match=r"run.json: unreadable .*--fresh"):
        RunDirectory.resume(run.path)


def test_a_second_process_is_refused_with_the_pid_of_the_first(scene, tmp_path):
    code = (
        "import sys; from pathlib import Path; from cqrun.store.run import RunDirectory;"
        "RunDirectory.resume(Path(sys.argv[1]))"
    )
    with start(scene, tmp_path) as run:
        command = [sys.executable, "-c", code, str(run.path)]
        refused = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
        holder = (run.path / "lock").read_text().split()[0]
        with pytest.raises(UsageError, match="another process works on this run"):
            start(scene, tmp_path, fresh=True)
        assert (run.path / "run.json").exists()
    assert refused.returncode == 1
    assert f"UsageError: {run.path}: another process works on this run (pid {holder} on" in refused.stderr
    subprocess.run(command, check=True, cwd=ROOT)


def test_a_directory_that_cannot_be_written_is_refused(scene, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match=r"choose another place with --out$"):
        start(scene, tmp_path / "file")
