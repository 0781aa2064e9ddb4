"""python -m benchmarks.papers.families.train_ppo SCENE EPISODES SEED FILE HEADER OVERRIDE...

Train PPO of stable-baselines3 in a scene. Write the loss at the end of every episode, with exploration, to FILE, below
the line HEADER. Use a process of its own with one thread: torch has one stream of random numbers in a process, and its
sums depend on the number of threads. A killed training continues from FILE.checkpoint, which is written after
every ten episodes, and gives the same numbers.
"""

from __future__ import annotations

import copy
import io
import pickle
import random
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.errors import CqrunError
from cqrun.store.atomic import write_bytes, write_text
from cqrun.store.lock import DirectoryLock

EPISODES_AN_UPDATE = 10
"""Of the networks."""


def main(words: Sequence[str]) -> None:
    """Train as the words say."""
    scene, episodes, seed, file, header, *overrides = words
    checkpoint = checkpoint_of(Path(file))
    lock = DirectoryLock(Path(file).parent)  # a training whose parent was killed may still run
    try:
        if not Path(file).exists():  # that training may have ended since
            losses = train_ppo(Path(scene), overrides, int(episodes), int(seed), checkpoint)
            write_text(Path(file), "\n".join([header, *(f"{loss:.6g}" for loss in losses)]) + "\n")
            checkpoint.unlink(missing_ok=True)
    finally:
        lock.release()


def checkpoint_of(file: Path) -> Path:
    """Return the checkpoint of the training that ends in a file."""
    return file.with_name(f"{file.name}.checkpoint")


def episodes_in(checkpoint: Path) -> int:
    """Return how many episodes a checkpoint holds; 0 if there is none."""
    return len(pickle.loads(checkpoint.read_bytes())["losses"]) if checkpoint.exists() else 0


def train_ppo(scene: Path, overrides: Sequence[str], episodes: int, seed: int, checkpoint: Path) -> list[float]:
    """Return the loss at the end of every episode."""
    import gymnasium
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    import cqrun

    class Remembering(gymnasium.Wrapper[Any, Any, Any, Any]):
        """Remembers the random state before an episode's goals were drawn, and its actions, to repeat the episode."""

        random_state: Any = None

        def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
            if seed is None:
                self.random_state = copy.deepcopy(self.unwrapped.np_random.bit_generator.state)
            self.actions: list[Any] = []
            return super().reset(seed=seed, options=options)

        def step(self, action: Any) -> Any:
            self.actions.append(np.array(action))
            return super().step(action)

    class Checkpoints(BaseCallback):
        """Counts episodes, and writes a checkpoint before every update."""

        def _on_step(self) -> bool:
            ended = zip(self.locals["dones"], self.locals["infos"], strict=True)
            losses.extend(facts["loss"] for done, facts in ended if done)
            return len(losses) < episodes

        def _on_rollout_start(self) -> None:
            if world.random_state is not None:
                write_bytes(checkpoint, pickle.dumps(state()))

    def state() -> dict[str, Any]:
        networks = io.BytesIO()
        model.save(networks)
        return {
            "losses": losses, "networks": networks.getvalue(), "scales": pickle.dumps(env), "returns": env.returns,
            "random": (torch.get_rng_state().numpy(), np.random.get_state(), random.getstate()),  # noqa: NPY002
            "world": (world.random_state, world.actions, scene_world.least, scene_world.most),
        }  # fmt: skip

    torch.set_num_threads(1)
    losses: list[float] = []
    world = Remembering(cqrun.environment(scene, list(overrides), threads=1))
    scene_world: Any = world.unwrapped
    steps = scene_world.agent.model.n_controls
    worlds = DummyVecEnv([lambda: world])
    if not checkpoint.exists():
        env = VecNormalize(worlds)
        model = PPO(
            "MlpPolicy", env, n_steps=EPISODES_AN_UPDATE * steps, batch_size=5 * steps // 2, device="cpu", seed=seed
        )
    else:
        saved = pickle.loads(checkpoint.read_bytes())
        losses = saved["losses"]
        model, env = _restored(saved, worlds, world)
    model.learn(episodes * steps - model.num_timesteps, callback=Checkpoints(), reset_num_timesteps=not losses)
    return losses


def _restored(saved: dict[str, Any], worlds: Any, world: Any) -> tuple[Any, Any]:
    """Return the networks and the scaled worlds of a checkpoint; restore the random numbers and the episode.

    After an episode that blew up, episodes no longer begin with an update of the networks. So the actions of an episode
    that was begun before the checkpoint are repeated.
    """
    import torch
    from stable_baselines3 import PPO

    env = pickle.loads(saved["scales"])
    env.set_venv(worlds)
    env.returns = saved["returns"]  # VecNormalize does not pickle them
    model = PPO.load(io.BytesIO(saved["networks"]), env=env, device="cpu", force_reset=False)
    worlds.reset()  # uses up the seed that loading has left for it
    scene_world = world.unwrapped
    scene_world.np_random.bit_generator.state, actions, least, most = saved["world"]
    world.reset()
    for action in actions:
        world.step(action)
    scene_world.least, scene_world.most = least, most
    torch.set_rng_state(torch.from_numpy(saved["random"][0]))
    np.random.set_state(saved["random"][1])  # noqa: NPY002  stable-baselines3 draws from it
    random.setstate(saved["random"][2])
    return model, env


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except CqrunError as error:
        sys.exit(str(error))
