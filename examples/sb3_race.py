"""Train a racing policy with PPO of Stable-Baselines3 on pairs of frames, and export it.

Run: pip install 'diffracing-suite[sb3]'; python examples/sb3_race.py runs/sb3 [MINUTES]; then
suite eval --policy runs/sb3/policy.onnx --track random --vehicle racer5 --trials 100
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecFrameStack, VecMonitor, VecNormalize

from eval.envs.sb3_env import RaceVecEnv
from policies.formats.export import export_module
from policies.spec import PolicySpec
from tracks.geometry.camera import Camera

SPEC = PolicySpec(rate_hz=15.0, camera=Camera(width=8, height=6))  # few pixels, few decisions
SETTINGS = {"track": "random", "level": 0, "spec": SPEC}  # of the environment


class ExportedActor(torch.nn.Module):
    """The actor to export; its hidden state is the previous frame, zeros at the start."""

    def __init__(self, model: PPO, normalisation: VecNormalize) -> None:
        """Take the policy of a trained `model`, and the scale of its observations."""
        super().__init__()
        self.policy = model.policy
        statistics = normalisation.obs_rms["state"]
        self.mean = torch.tensor(statistics.mean).float()
        self.deviation = torch.tensor((statistics.var + normalisation.epsilon) ** 0.5).float()

    def forward(
        self, state: torch.Tensor, image: torch.Tensor, hidden: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the mean action, which the contract clips and scales, and this frame."""
        state = ((state - self.mean) / self.deviation).clamp(-10.0, 10.0)
        frame = torch.cat([state, image.flatten(1)], -1)
        sizes = [state.shape[1], image[0].numel()]
        pairs = zip(hidden.split(sizes, -1), frame.split(sizes, -1), strict=True)
        state, image = (torch.cat(pair, -1) for pair in pairs)
        return self.policy.get_distribution({"state": state, "image": image}).mode(), frame


def main(out: Path, minutes: float, envs: int = 128, rollout: int = 32) -> Path:
    """Train for some minutes, and return the path of the exported policy."""
    torch.set_num_threads(1)  # the network is small
    races = RaceVecEnv(envs, **SETTINGS)
    normalised = VecNormalize(VecMonitor(races), gamma=0.98, norm_obs_keys=["state"])
    network = {"net_arch": [64, 64], "log_std_init": -1.5}
    stacked = VecFrameStack(normalised, 2)
    model = PPO("MultiInputPolicy", stacked, n_steps=rollout, batch_size=512, n_epochs=6,
                gamma=0.98, seed=0, policy_kwargs=network, device="cpu", verbose=1)  # fmt: skip
    end = time.monotonic() + 60.0 * minutes
    model.learn(10**9, lambda *_: time.monotonic() < end, log_interval=10)
    out.mkdir(parents=True, exist_ok=True)
    memory = (SPEC.state_size + SPEC.camera.height * SPEC.camera.width,)
    return export_module(
        ExportedActor(model, normalised), out / "policy.onnx", races.races.contract, memory
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), float(sys.argv[2]) if sys.argv[2:] else 25.0)
