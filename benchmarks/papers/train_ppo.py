"""python -m benchmarks.papers.train_ppo SCENE EPISODES SEED FILE HEAD OVERRIDE...

PPO in a scene, as stable-baselines3 has it: the loss at the end of every episode, as it explores, to FILE, below HEAD.
In a process of its own, on one thread: torch's random numbers are one stream a process, and its sums hang on threads.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from cqrun.store.atomic import write_text


def main(words: Sequence[str]) -> None:
    """Train as the words say."""
    scene, episodes, seed, file, head, *overrides = words
    losses = train_ppo(Path(scene), overrides, int(episodes), int(seed))
    write_text(Path(file), "\n".join([head, *(f"{loss:.6g}" for loss in losses)]) + "\n")


def train_ppo(scene: Path, overrides: Sequence[str], episodes: int, seed: int) -> list[float]:
    """Return the loss at the end of every episode."""
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    import cqrun

    torch.set_num_threads(1)
    losses: list[float] = []

    class Keep(BaseCallback):
        def _on_step(self) -> bool:
            over = zip(self.locals["dones"], self.locals["infos"], strict=True)
            losses.extend(facts["loss"] for done, facts in over if done)
            return len(losses) < episodes

    env = VecNormalize(DummyVecEnv([lambda: cqrun.environment(scene, list(overrides), threads=1)]))
    steps = env.envs[0].agent.model.n_controls
    model = PPO("MlpPolicy", env, n_steps=10 * steps, batch_size=5 * steps // 2, device="cpu", seed=seed)
    model.learn(episodes * steps, callback=Keep())
    return losses


if __name__ == "__main__":
    main(sys.argv[1:])
