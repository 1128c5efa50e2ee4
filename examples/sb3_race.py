"""Train PPO of Stable-Baselines3 on races, frames stacked in twos, and export it for the judge.

Run: pip install 'diffracing-suite[sb3]'; python examples/sb3_race.py runs/sb3 [STEPS]; then
suite eval --policy runs/sb3/policy.onnx --track random --trials 100
"""

# pyright: reportMissingImports=false
from __future__ import annotations

import sys
from pathlib import Path

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecFrameStack

from eval.envs.gymnasium_env import RaceEnv
from policies.formats.export import export_module

SETTINGS = {"track": "random", "level": 0, "rewards": {"progress": 1.0, "gate": 5.0, "crash": -5.0}}


class Judged(torch.nn.Module):
    """The actor as the judge calls it: what it remembers is the frame before, zeros at first."""

    def __init__(self, model: PPO) -> None:
        """Take the policy of a trained `model`."""
        super().__init__()
        self.policy = model.policy

    def forward(
        self, state: torch.Tensor, image: torch.Tensor, hidden: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the mean action, which the contract clips and scales, and this frame."""
        count, size = state.shape[1], image.shape[1:]
        before = hidden[:, count:].reshape(-1, *size)
        frames = {
            "state": torch.cat([hidden[:, :count], state], -1),
            "image": torch.cat([before, image], -1),
        }
        features = self.policy.extract_features(frames, self.policy.pi_features_extractor)
        actor = self.policy.mlp_extractor.forward_actor(features)
        return self.policy.action_net(actor), torch.cat([state, image.flatten(1)], -1)


def main(out: Path, steps: int, envs: int = 8, rollout: int = 256) -> Path:
    """Train for `steps` decisions and return the file."""
    vector = VecFrameStack(make_vec_env(RaceEnv, envs, seed=0, env_kwargs=SETTINGS), 2)
    network = {"net_arch": [128, 128], "log_std_init": -1.0}
    model = PPO("MultiInputPolicy", vector, n_steps=rollout, batch_size=256, gamma=0.99,
                learning_rate=3e-4, seed=0, policy_kwargs=network, device="cpu")  # fmt: skip
    model.learn(steps)
    contract = RaceEnv(**SETTINGS).contract
    memory = (12 + 24 * 32,)
    out.mkdir(parents=True, exist_ok=True)
    return export_module(Judged(model), out / "policy.onnx", contract, memory)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]) if sys.argv[2:] else 1_000_000)
