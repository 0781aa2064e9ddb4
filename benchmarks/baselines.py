"""Gradients against learners without: PPO and CMA-ES on the finger and the biped, at the same tasks (CQ1 Fig 7, V-B).

    python benchmarks/baselines.py [--only finger biped] [--seeds 3] [--runs DIR] [--out DIR]

Needs the extras `rl` and `evo`. Every method has the scene's own robot, observations and objective; the gradient and
CMA-ES have its controller too, PPO a network of its own (64 x 64), stable-baselines3's defaults, and observations and
rewards normalised. An episode is one rollout. Written for each task: TASK.json (episodes to each threshold, by seed),
TASK.csv (the curves) and TASK.png. Curves that are there already are not run again.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from control_scenes import smooth

import cqrun
from cqrun.figures.style import COLOURS, new_figure, save
from cqrun.fingerprint import engine_hash
from cqrun.jobs.control import run_control
from cqrun.store.atomic import write_json, write_text

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Task:
    """A scene, how it is judged, and how long it is tried.

    Attributes:
        scene: in scenes/control.
        label: what is measured, a function of the loss at an episode's end.
        measure: that function.
        thresholds: below which episodes are counted.
        reward: overrides for PPO, whose reward is by how much the loss falls.
        loss_of: from PPO's loss under those overrides to the scene's own.
        gradient, generations, episodes: iterations of each method at most.
    """

    scene: str
    label: str
    measure: Callable[[np.ndarray], np.ndarray]
    thresholds: tuple[float, ...]
    reward: tuple[str, ...] = ()
    loss_of: Callable[[np.ndarray], np.ndarray] = np.asarray
    gradient: int = 100
    generations: int = 150
    episodes: int = 1500

    @property
    def path(self) -> Path:
        """The scene's file."""
        return ROOT / "scenes" / "control" / f"{self.scene}.yaml"


TASKS = {
    # the reward of CQ1's PPO is the velocity towards the goal, whose sum is the distance that was gained
    "finger": Task(
        "finger", "distance of the tip", np.sqrt, (0.02, 0.01), ("objective.tip.reach.squared=false",), np.square, 60
    ),
    "biped": Task("biped", "loss: -x + v^2 of the head", np.asarray, (-0.3, -0.5), episodes=1000),
}


def by_gradient(task: Task, seed: int, runs: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return episodes and losses of the scene's own optimizer."""
    rows = _history(task, [f"optimizer.sgd.max_iterations={task.gradient}", f"seed={seed}"], runs / "gradient")
    return np.arange(1, len(rows) + 1), rows


def by_cma_es(task: Task, seed: int, runs: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return episodes and losses of the best of each generation; its size is CMA-ES's own, 4 + 3 ln n."""
    n = sum(np.size(block) for block in cqrun.load(task.path).params.values())
    size = 4 + int(3 * np.log(n))
    method = f"optimizer={{cma_es: {{max_iterations: {task.generations}, population: {size}}}}}"
    rows = _history(task, [method, f"seed={seed}"], runs / "cma_es")
    return 1 + size * np.arange(len(rows)), rows


def _history(task: Task, overrides: list[str], runs: Path) -> np.ndarray:
    run = run_control(task.path, overrides, runs, False, 1, True)
    return np.array([float(row["loss"]) for row in csv.DictReader((run / "history.csv").open())])


def by_ppo(task: Task, seed: int, runs: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return episodes and losses of PPO as it explores."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    losses: list[float] = []

    class Keep(BaseCallback):
        def _on_step(self) -> bool:
            over = zip(self.locals["dones"], self.locals["infos"], strict=True)
            losses.extend(facts["loss"] for done, facts in over if done)
            return len(losses) < task.episodes

    env = VecNormalize(DummyVecEnv([lambda: cqrun.environment(task.path, list(task.reward), threads=1)]))
    steps = env.envs[0].agent.model.n_controls  # type: ignore[attr-defined]
    model = PPO("MlpPolicy", env, n_steps=10 * steps, batch_size=5 * steps // 2, device="cpu", seed=seed)
    model.learn(task.episodes * steps, callback=Keep())
    return np.arange(1, len(losses) + 1), task.loss_of(np.array(losses))


METHODS = {"gradient": by_gradient, "cma_es": by_cma_es, "ppo": by_ppo}
WINDOW = {"gradient": 1, "cma_es": 1, "ppo": 10}
"""Episodes over which a curve is averaged, as CQ1 does with PPO; a generation counts by its best."""


def curve(text: Path, run: Callable[[], tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Return a curve from its file, or run it and write that."""
    if not text.exists():
        rows = ["episode,loss", *(f"{k},{loss!r}" for k, loss in zip(*(a.tolist() for a in run()), strict=True))]
        text.parent.mkdir(parents=True, exist_ok=True)
        write_text(text, "\n".join(rows) + "\n")
    episode, loss = np.loadtxt(text, delimiter=",", skiprows=1, unpack=True)
    return episode, loss


def draw(task: Task, curves: dict[str, list[tuple[np.ndarray, np.ndarray]]], png: Path) -> None:
    """Draw the measure against episodes: every seed, thresholds dotted."""
    figure = new_figure(6.0, 3.6)
    axes = figure.add_subplot()
    for colour, (method, seeds) in zip(COLOURS, curves.items(), strict=False):
        for k, (episode, value) in enumerate(seeds):
            axes.plot(episode, value, color=colour, lw=1.2, alpha=0.8, label=None if k else method.replace("_", "-"))
    for threshold in task.thresholds:
        axes.axhline(threshold, color="0.5", lw=0.8, ls=":")
    axes.set_xscale("log")
    if min(task.thresholds) > 0:
        axes.set_yscale("log")
    axes.set_xlabel("episodes")
    axes.set_ylabel(task.label)
    axes.legend(frameon=False)
    save(figure, png.with_suffix(""))


def main() -> None:
    """Run what is missing and write each task's figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=list(TASKS), default=list(TASKS))
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--runs", type=Path, default=Path("results") / "baselines")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "measured" / "baselines")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.only:
        task, curves, found = TASKS[name], {}, dict[str, Any]()
        for method in options.methods:
            curves[method] = []
            for seed in range(options.seeds if method != "gradient" else 1):
                text = options.out / name / f"{method}-{seed}.csv"
                episode, loss = curve(text, lambda: METHODS[method](task, seed, options.runs / name))  # noqa: B023
                curves[method].append((episode, smooth(task.measure(loss), WINDOW[method])))
            found[method] = [
                {
                    "episodes": int(episode[-1]),
                    "best": float(value.min()),
                    "below": {f"{t:g}": next((int(e) for e, v in zip(episode, value, strict=True) if v < t), None)
                              for t in task.thresholds},
                }
                for episode, value in curves[method]
            ]  # fmt: skip
            print(name, method, found[method], flush=True)
        command = "python benchmarks/baselines.py"
        write_json(options.out / f"{name}.json", {"command": command, "engine": engine_hash(), **found})
        draw(task, curves, options.out / f"{name}.png")


if __name__ == "__main__":
    main()
