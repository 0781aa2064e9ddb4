"""python -m benchmarks.papers.families.train_ppo SCENE EPISODES SEED FILE HEAD OVERRIDE...

PPO in a scene, as stable-baselines3 has it: the loss at the end of every episode, as it explores, to FILE, below HEAD.
In a process of its own, on one thread: torch's random numbers are one stream a process, and its sums hang on threads.
Killed, it goes on from FILE.checkpoint, written after every ten episodes, and finds the same numbers.
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

AT_ONCE = 10
"""Episodes between two updates of the networks."""


def main(words: Sequence[str]) -> None:
    """Train as the words say."""
    scene, episodes, seed, file, head, *overrides = words
    kept = checkpoint_of(Path(file))
    lock = DirectoryLock(Path(file).parent)  # whoever began it may have been killed, and it goes on
    try:
        if not Path(file).exists():  # it may have come to its end since
            losses = train_ppo(Path(scene), overrides, int(episodes), int(seed), kept)
            write_text(Path(file), "\n".join([head, *(f"{loss:.6g}" for loss in losses)]) + "\n")
            kept.unlink(missing_ok=True)
    finally:
        lock.release()


def checkpoint_of(file: Path) -> Path:
    """Return where training that is to end in a file goes on from."""
    return file.with_name(f"{file.name}.checkpoint")


def episodes_in(kept: Path) -> int:
    """Return how many episodes a checkpoint holds; 0 without one."""
    return len(pickle.loads(kept.read_bytes())["losses"]) if kept.exists() else 0


def train_ppo(scene: Path, overrides: Sequence[str], episodes: int, seed: int, kept: Path) -> list[float]:
    """Return the loss at the end of every episode."""
    import gymnasium
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    import cqrun

    class Remembering(gymnasium.Wrapper[Any, Any, Any, Any]):
        """Keeps what an episode's goals were drawn with, and what was done in it, so that it can be begun again."""

        drawn_with: Any = None

        def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
            if seed is None:
                self.drawn_with = copy.deepcopy(self.unwrapped.np_random.bit_generator.state)
            self.acted: list[Any] = []
            return super().reset(seed=seed, options=options)

        def step(self, action: Any) -> Any:
            self.acted.append(np.array(action))
            return super().step(action)

    class Keep(BaseCallback):
        """Counts episodes, and writes a checkpoint after every ten."""

        def _on_step(self) -> bool:
            over = zip(self.locals["dones"], self.locals["infos"], strict=True)
            losses.extend(facts["loss"] for done, facts in over if done)
            return len(losses) < episodes

        def _on_rollout_start(self) -> None:
            if world.drawn_with is not None:
                write_bytes(kept, pickle.dumps(state()))

    def state() -> dict[str, Any]:
        networks = io.BytesIO()
        model.save(networks)
        return {
            "losses": losses, "networks": networks.getvalue(), "scales": pickle.dumps(env), "returns": env.returns,
            "random": (torch.get_rng_state().numpy(), np.random.get_state(), random.getstate()),  # noqa: NPY002
            "world": (world.drawn_with, world.acted, own.least, own.most),
        }  # fmt: skip

    torch.set_num_threads(1)
    losses: list[float] = []
    world = Remembering(cqrun.environment(scene, list(overrides), threads=1))
    own: Any = world.unwrapped
    steps = own.agent.model.n_controls
    worlds = DummyVecEnv([lambda: world])
    if not kept.exists():
        env = VecNormalize(worlds)
        model = PPO("MlpPolicy", env, n_steps=AT_ONCE * steps, batch_size=5 * steps // 2, device="cpu", seed=seed)
    else:
        told = pickle.loads(kept.read_bytes())
        losses = told["losses"]
        model, env = _taken_up(told, worlds, world)
    model.learn(episodes * steps - model.num_timesteps, callback=Keep(), reset_num_timesteps=not losses)
    return losses


def _taken_up(told: dict[str, Any], worlds: Any, world: Any) -> tuple[Any, Any]:
    """Return networks and scaled worlds as a checkpoint has them; put random numbers and the episode back.

    Where one blew up, the next ones are not begun with an update of the networks: such an episode is acted once more.
    """
    import torch
    from stable_baselines3 import PPO

    env = pickle.loads(told["scales"])
    env.set_venv(worlds)
    env.returns = told["returns"]  # which are not among what it pickles
    model = PPO.load(io.BytesIO(told["networks"]), env=env, device="cpu", force_reset=False)
    worlds.reset()  # takes the seed that loading has left for it
    own = world.unwrapped
    own.np_random.bit_generator.state, acted, least, most = told["world"]
    world.reset()
    for action in acted:
        world.step(action)
    own.least, own.most = least, most
    torch.set_rng_state(torch.from_numpy(told["random"][0]))
    np.random.set_state(told["random"][1])  # noqa: NPY002  what stable-baselines3 draws from
    random.setstate(told["random"][2])
    return model, env


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except CqrunError as error:
        sys.exit(str(error))
