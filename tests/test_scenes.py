"""The shipped scenes: each is valid, runs when shortened, and has a gradient that agrees with differences."""

from __future__ import annotations

import json
import re
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from small_beam import result_of

import cqrun
from cqrun.build.model import build
from cqrun.errors import SceneError
from cqrun.jobs.control import run_codesign, run_control
from cqrun.jobs.gradcheck import run_gradcheck
from cqrun.jobs.simulate import run_simulate
from cqrun.jobs.sysid import run_sysid
from cqrun.jobs.table import report_lines
from cqrun.jobs.validate import validate
from cqrun.measurements.recording import Recording
from cqrun.scene.load import load_scene
from cqrun.scene.schema import Scene
from cqrun.scene.schema_json import scene_json_schema
from cqrun.store.formats.long_table import write_csv

ROOT = Path(__file__).parents[1]
SCENES = sorted((ROOT / "scenes").rglob("*.yaml"))
SCHEMA = ROOT / "scenes" / "cqrun.schema.json"
RATE = 100.0
"""Frame rate of artificial recordings [Hz]."""


def elastic(*bodies: str) -> list[str]:
    """Return overrides that give bodies the fixed-corotated law; each law has its own tests."""
    law = "{fixed_corotated: {youngs_modulus: 10, poissons_ratio: 0.3}}"
    return [f"bodies.{body}.material.elastic={law}" for body in bodies]


def designed(body: str) -> list[str]:
    """Return overrides that give a body the fixed-corotated law, with unknown stiffness and density per particle."""
    E = f"bodies.{body}.material.elastic.fixed_corotated.youngs_modulus: {{bounds: [7, 20], per: particle}}"
    rho = f"bodies.{body}.material.density: {{bounds: [0.7, 2], per: particle}}"
    return [*elastic(body), f"unknowns={{{E}, {rho}}}"]


FLOOR = {2: 0.05, 3: 0.0667}
"""Height of the floor in short runs [m]."""


def boundaries(dim: int, thickness: float | None = None) -> str:
    """Return an override with the boundaries of the fingers and the arm: walls, and a clamp of a few nodes.

    Use walls without thickness for robots with which differences would cross kinks of the floor's friction.
    """
    thick = FLOOR[dim] if thickness is None else thickness
    clamp = f"{{sticky: {{region: {{box: {{corner: {[0.8] * dim}, size: {[0.1] * dim}}}}}}}}}"
    return f"boundaries={{walls: {{friction: {{face: all, coefficient: 0.5, thickness: {thick}}}}}, clamp: {clamp}}}"


def standing(body: str, *at: float) -> str:
    """Return an override that places a walker's feet close to the nodes of the floor, so that it does not fall."""
    return f"bodies.{body}.place.offset={list(at)}"


# Other laws, actuators or boundaries need other kernels, so these overrides make scenes share kernels.
SMALLER = {
    "real_beam": ["world.dx=0.01"],
    "real_beam_rest": ["world.dx=0.01"],
    "real_beam_material": ["world.dx=0.01"],
    "tentacle": ["world.dx=0.012", "bodies.arm.spacing=0.006", "bodies.arm.shape.cone.end_radius=0.014"],
    "collision": ["bodies.a.shape.ball.center=[0.3, 0.4416]"],  # the balls touch from the start
    "finger_material": ["activation.random.sequences=2", "data.synthetic.copies=2"],
    "finger": ["bodies.finger.sampling.lattice.count=10"],
    "finger_random": ["bodies.finger.sampling.lattice.count=10", "episodes.unseen=2"],
    "finger_wide": ["bodies.finger.sampling.lattice.count=10", "episodes.unseen=2"],
    "biped": ["bodies.biped.sampling.lattice.count=6", boundaries(2), standing("biped", 0.2, 0.06)],
    "biped_cable": ["bodies.biped.spacing=0.00625",
                    "boundaries={base: {sticky: {region: {box: {corner: [0, 0], size: [1, 0.1]}}}}}"],
    "rhino": ["bodies.rhino.spacing=0.01", "time.substeps=2", boundaries(2), *elastic("rhino"),
              standing("rhino", 0.2, 0.04)],
    "biped_terrain": ["bodies.biped.sampling.lattice.count=8", "bodies.terrain.spacing=0.0125", "time.substeps=10",
                      standing("biped", 0.2, 0.115), *elastic("biped", "terrain")],
    "quadruped": ["bodies.quadruped.sampling.lattice.count=4", boundaries(3), standing("quadruped", 0.2, 0.07, 0.1)],
    "crawler": ["bodies.crawler.sampling.lattice.count=4", boundaries(3), standing("crawler", 0.2, 0.07, 0.1)],
    "arm_reach_3d": ["bodies.arm.sampling.lattice.count=4", "episodes.count=2", "episodes.unseen=1"],
    "leg_actuate": ["bodies.leg.spacing=0.5", "world.dx=1.6", "time.substeps=40"],
    "leg_drop": ["bodies.leg.spacing=0.5", "world.dx=1.6", "time.substeps=40",
                 "bodies.leg.place={offset: [0, -15, 0]}"],  # in free fall the material has no effect
    "arm_two_link": ["bodies.arm.sampling.lattice.count=10", boundaries(2)],
    "arm_3d": ["bodies.arm.sampling.lattice.count=4", boundaries(3), *designed("arm")],
    "biped_codesign": ["bodies.biped.sampling.lattice.count=10", "bodies.biped.spin=[9]", boundaries(2),
                       standing("biped", 0.2, 0.04), *designed("biped")],
    **{
        f"{name}_codesign": [f"bodies.{name}.sampling.lattice.count=3", boundaries(3, 0.0), *designed(name)]
        for name in ("quadruped", "hexapod", "octopod")
    },
    "gripper_least": ["world.dx=0.006"],
    "finger_codesign": ["world.dx=0.002", "bodies.finger.spacing=0.001"],
    "creature": ["bodies.creature.spacing=0.02", "time.substeps=2", boundaries(3, 0.0), *elastic("creature")],
}  # fmt: skip
"""Overrides that make a scene faster, in addition to a shorter run."""

PAPERS = {
    "finger": (4_800, 150),
    "finger_random": (4_800, 150),
    "finger_wide": (4_800, 150),
    "biped": (2_800, 600),
    "quadruped": (84_375, 800),
    "crawler": (64_125, 400),
    "leg_drop": (290_000, 9_600),
    "leg_actuate": (290_000, 4_800),
    "arm_reach_3d": (50_625, 600),  # CQ1 has 200 substeps, each of which is three here
    "biped_cable": (5_024, 8_000),
    "rhino": (20_000, 8_000),
    "creature": (22_084, 8_000),
    "biped_terrain": (36_200, 20_000),
    "arm_two_link": (1_176, 800),
    "arm_length": (816, 250),
    "arm_3d": (17_280, 2_000),
    "biped_codesign": (12_800, 2_000),
    "quadruped_codesign": (84_375, 600),
    "hexapod_codesign": (111_375, 600),
    "octopod_codesign": (138_375, 600),
}
"""Numbers of particles and substeps of the robots in the papers."""

FROM_FILES = ("rhino", "creature")
"""Robots from our own image or mesh, whose number of particles is only nearly that of the papers."""

scene_files = pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)


def job_of(path: Path) -> str:
    """Return the job that a scene names."""
    found = re.search(r"^job: (\w+)$", path.read_text(), re.MULTILINE)
    return found[1] if found else ""


MOVING = [path for path in SCENES if job_of(path) != "rest"]  # rest has no time
moving_scenes = pytest.mark.parametrize("path", MOVING, ids=lambda path: path.stem)


def recorded(scene: Scene, folder: Path) -> list[str]:
    """Write an artificial recording, with small motion, for each recording of a scene; return overrides to use them."""
    rng = np.random.default_rng(0)
    overrides = []
    for name, spec in ((scene.data and scene.data.recordings) or {}).items():
        if spec.measurement.at_rest:
            overrides.append(f"data.recordings.{name}.file={_poses(spec, folder / f'{name}.csv')}")
            continue
        end = spec.start + scene.time.duration + 1.0
        time = np.arange(round(end * RATE)) / RATE
        markers = spec.measurement.rest
        rest = np.array(list(markers.values()))
        swing = 1e-3 * np.sin(30.0 * np.maximum(time - spec.start, 0.0))[:, None, None] * np.eye(3)[2]
        positions = rest + swing + 1e-5 * rng.normal(size=(len(time), *rest.shape))
        write_csv(Recording(time, tuple(markers), positions, name), folder / f"{name}.csv")
        overrides.append(f"data.recordings.{name}.file={folder / f'{name}.csv'}")
    return overrides


def _poses(spec: Any, file: Path) -> Path:
    """Write two poses near the rest shape, one under small loads, and return their file."""
    loads, markers = list(spec.measurement.loads), spec.measurement.rest
    lines = [",".join(["pose", *loads, "marker", "x", "y", "z"])]
    for pose, size in enumerate((0.0, 0.1)):
        for marker, place in markers.items():
            numbers = [*[size] * len(loads), marker, *(place - np.array(spec.offset) - 0.01 * size).tolist()]
            lines.append(",".join(map(str, [pose, *numbers])))
    file.write_text("\n".join(lines) + "\n")
    return file


def shortened(path: Path, folder: Path, *, steps: int = 2) -> list[str]:
    """Return overrides for a few control steps, one iteration, and artificial recordings."""
    scene = load_scene(path)
    overrides = [*SMALLER.get(path.stem, []), f"time.duration={steps * scene.time.control_step!r}"]
    for name, spec in ((scene.data and scene.data.recordings) or {}).items():
        if spec.length is not None:
            overrides.append(f"data.recordings.{name}.length={steps * scene.time.control_step!r}")
        overrides.append(f"data.recordings.{name}.skip=0")
        if f"data.recordings.{name}.start" in scene.unknowns:
            bounds = [spec.start - 1e-3, spec.start + 1e-3]
            overrides.append(f"unknowns.data.recordings.{name}.start.bounds={bounds}")
    if scene.optimizer is not None:
        overrides.append(f"optimizer.{scene.optimizer.name}.max_iterations=1")
    return [*overrides, *recorded(scene, folder)]


def loosened(path: Path) -> list[str]:
    """Return overrides that make all upper bounds of constraints easy to meet in a short run."""
    scene = load_scene(path)
    return [f"constraints.{name}.at_most=1000" for name, c in scene.constraints.items() if c.at_most is not None]


def test_the_expected_scenes_exist():
    wanted = {"beam_twin", "collision", "finger_material", "real_beam", "hydraulic_finger", "finger_codesign", *PAPERS}
    assert wanted <= {path.stem for path in SCENES}


def test_the_schema_is_up_to_date():
    assert json.loads(SCHEMA.read_text()) == scene_json_schema(), "run: cqrun schema > scenes/cqrun.schema.json"


@scene_files
def test_a_scene_names_the_schema_and_its_job(path):
    first = path.read_text().splitlines()[0]
    match = re.fullmatch(r"# yaml-language-server: \$schema=(\S+)", first)
    assert match
    assert (path.parent / match[1]).resolve() == SCHEMA
    assert load_scene(path).job == job_of(path)
    assert path.parent.name in (job_of(path), "robots")
    assert load_scene(path).title


@scene_files
def test_a_scene_is_valid(path, tmp_path):
    text = "\n".join(validate(path, recorded(load_scene(path), tmp_path)))
    assert text.startswith(f"{path}: a valid scene: ")
    assert "particles, " in text


@pytest.mark.parametrize("path", [path for path in SCENES if "recordings:" in path.read_text()], ids=lambda p: p.stem)
def test_the_error_of_missing_recordings_says_where_to_get_them(path, tmp_path):
    copy = tmp_path / path.name  # without the recordings that may lie beside the scene
    copy.write_text(path.read_text())
    with pytest.raises(SceneError) as info:
        list(validate(copy))
    for problem in info.value.problems:
        assert problem.path.endswith(".file")
        assert "there is no file" in problem.message
        assert "the scene's header says where to download the recordings" in problem.message
    head = path.read_text().partition("\ncqrun: 1")[0]
    assert re.search("public repository (srl-ethz/diffPD_sim2real|tud-phi/soromox)|see real_beam.yaml", head)


@pytest.mark.parametrize("name", PAPERS)
def test_a_scene_has_the_size_of_the_paper(name):
    (path,) = (path for path in SCENES if path.stem == name)
    built = build(load_scene(path))
    particles, substeps = PAPERS[name]
    assert built.model.n_steps == substeps
    assert built.particles.layout.n_particles == pytest.approx(particles, rel=0.01 if name in FROM_FILES else 0)


def test_cables_shorten_the_legs_to_seven_tenths():
    (path,) = (path for path in SCENES if path.stem == "biped_cable")
    weightless = ["world.gravity=[0, 0]", "controller.open_loop.initial=0", "controller.open_loop.noise=0"]
    motion = cqrun.load(path, [*weightless, "time.duration=1.5"]).simulate()
    start, foot = motion.x[0], motion.x[0, :, 1] < 0.102
    hip = (np.abs(start[:, 1] - 0.2) < 0.0017) & (
        start[:, 0] % 0.2 < 0.1
    )  # the nearest rows of the feet and of the body
    legs = motion.x[-100:, hip, 1].mean() - motion.x[-100:, foot, 1].mean()
    assert legs / (start[hip, 1].mean() - start[foot, 1].mean()) == pytest.approx(0.70, abs=0.01)


def test_the_shape_files_agree_with_their_script():
    folder = ROOT / "scenes" / "control" / "shapes"
    script = runpy.run_path(str(folder / "make_shapes.py"))
    with Image.open(folder / "rhino.png") as drawn:
        assert np.array_equal(np.asarray(drawn.convert("RGB")), np.asarray(script["rhino"]()))
    triangles = script["surface"](script["CELL"])
    mesh = trimesh.load_mesh(folder / "creature.stl")
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.triangles, triangles, atol=1e-7)


OWN_KERNELS = {
    "gripper_tendon", "gripper_pneumatic", "gripper_least", "real_beam_material", "real_beam_rest",
    "tentacle", "finger_codesign",
}  # fmt: skip
"""Scenes whose gradient needs kernels that no other test compiles, for minutes; tests/engine has that of each part."""


def unless_its_own(path: Path) -> Any:
    """Return a scene as a parameter of a test with gradients, which is a slow one if the scene has its own kernels."""
    return pytest.param(path, marks=pytest.mark.slow if path.stem in OWN_KERNELS else (), id=path.stem)


def of_job(*jobs: str) -> pytest.MarkDecorator:
    """Return a decorator that runs a test for the scenes of some jobs."""
    return pytest.mark.parametrize("path", [unless_its_own(path) for path in SCENES if job_of(path) in jobs])


@of_job("control", "codesign")
def test_a_shortened_scene_learns(path, tmp_path):
    overrides = [*shortened(path, tmp_path), *loosened(path)]
    scene = load_scene(path, overrides)
    learn = {"control": run_control, "codesign": run_codesign}[job_of(path)]
    run = learn(path, overrides, tmp_path, threads=1)
    result = result_of(run)
    if (result["status"], result["iterations"]) != (
        "iteration_limit",
        1,
    ):  # without motion the effort is already minimal
        assert (result["status"], result["iterations"], result["start"]["loss"]) == ("converged", 0, 0.0)
    assert result["unknowns"].keys() == scene.unknowns.keys()
    assert result["constraints"].keys() == scene.constraints.keys()
    for when in ("start", "trained"):
        assert result[when]["terms"].keys() == scene.objective.keys()
        assert np.isfinite(result[when]["loss"])
    assert len(result["unseen"]["episodes"] if result["unseen"] else []) == scene.episodes.unseen
    rows = (run / "activation.csv").read_text().splitlines()
    assert len(rows) == 1 + scene.time.control_steps
    assert (run / "controller.npz").exists()
    assert report_lines(run)


@of_job("sysid")
def test_a_shortened_identification_runs(path, tmp_path):
    run = run_sysid(path, shortened(path, tmp_path), tmp_path, threads=1)
    result = result_of(run)
    assert result["status"] in ("converged", "iteration_limit")
    assert result["iterations"] <= 1
    assert result["unknowns"].keys() == set(load_scene(path).unknowns)
    assert report_lines(run)


@moving_scenes
def test_a_shortened_scene_is_simulated(path, tmp_path):
    result = result_of(run_simulate(path, shortened(path, tmp_path), tmp_path, threads=1))
    assert result["status"] == "done"
    assert all(number == 0 for number in result["fracture"].values())


STANDING = [name for name, overrides in SMALLER.items() if any(".place.offset=" in o for o in overrides)]


@pytest.mark.parametrize("name", STANDING)
def test_walkers_stand_on_the_floor_in_gradient_checks(name):
    (path,) = (path for path in SCENES if path.stem == name)
    built = build(load_scene(path, SMALLER[name]))
    x, dx = built.particles.x, built.model.dx
    if name == "biped_terrain":  # on the crests of its hills
        ground = x[built.particles.of("terrain"), 1].max()
        x = x[built.particles.of("biped")]
    else:
        ground = dx * np.floor(FLOOR[built.model.dim] / dx)
    assert x[:, 1].min() - ground < 1.5 * dx


@pytest.mark.parametrize("path", [unless_its_own(path) for path in MOVING])
def test_the_gradient_of_a_scene_agrees_with_differences(path, tmp_path):
    scene = load_scene(path)
    # a controller needs a few steps until its effect exceeds rounding
    overrides = shortened(path, tmp_path, steps=2 if scene.controller is None else 6)
    if scene.controller is not None and scene.controller.name == "mlp":
        overrides.append("controller.mlp.activation=tanh")  # differences fail across the kinks of relu
    run, agrees = run_gradcheck(path, overrides, tmp_path, threads=1)
    assert agrees, "\n".join(report_lines(run))
    rows = json.loads((run / "gradcheck.json").read_text())["rows"]
    assert any(max(abs(row["adjoint"]), abs(row["differences"])) > row["noise"] for row in rows), "nothing was compared"


@pytest.mark.slow
@pytest.mark.parametrize("stem", ["beam_twin", "collision", "finger_material"])
def test_the_gradient_over_the_whole_run(stem, tmp_path):
    path = ROOT / "scenes" / "sysid" / f"{stem}.yaml"
    run, agrees = run_gradcheck(path, [], tmp_path, threads=2)
    assert agrees, "\n".join(report_lines(run))


def test_the_python_example_of_the_readme_runs(monkeypatch):
    """Run the example of the README with a shorter duration."""
    monkeypatch.chdir(ROOT)
    section = (ROOT / "README.md").read_text().partition("## From Python\n")[2].partition("\n## ")[0]
    before = section.partition("```")[0]  # the block between fences needs torch: jobs/test_own_loss has its like
    code = "\n".join(re.findall(r"^    (.*)$", before, re.MULTILINE))
    assert "time.duration=0.3" in code
    names: dict[str, object] = {}
    exec(code.replace("time.duration=0.3", "time.duration=0.02"), names)
    assert names["loss"] > 0
    assert names["gradient"].keys() >= names["problem"].params.keys()
    assert names["motion"].x.shape[0] == 3
