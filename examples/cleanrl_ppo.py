"""Train a racing policy with PPO in one file, in the style of CleanRL, and export it for judging.

Many races run at once. Run: python examples/cleanrl_ppo.py runs/ppo [MINUTES]; then
suite eval --policy runs/ppo/policy.onnx --track random --vehicle racer5 --trials 100
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import gymnasium
import numpy as np
import torch
from torch import nn
from torch.distributions import Normal

from eval.envs.gymnasium_env import ID
from policies.formats.export import export_module
from policies.spec import PolicySpec
from tracks.geometry.camera import Camera

EPOCHS, MINIBATCHES, GAMMA, LAMBDA, CLIP = 8, 12, 0.97, 0.95, 0.2
SPEC = PolicySpec(rate_hz=15.0, camera=Camera(width=12, height=8))
SCALE = torch.tensor([0.2] * 3 + [1.0] * 3 + [0.2] * 3 + [0.1] * 3)
"""Factors on the state: velocity [m/s], world z [1], next gate [m] and last action [m/s^2]."""


class Agent(nn.Module):
    """Actor and critic; a call returns the mean action, as the exported policy does."""

    def __init__(self) -> None:
        """Make networks whose first actions are nearly zero."""
        super().__init__()
        size = SPEC.state_size + SPEC.camera.height * SPEC.camera.width
        heads = nn.Linear(128, 3), nn.Linear(128, 1)
        nn.init.normal_(heads[0].weight, std=0.001)
        self.actor, self.critic = (
            nn.Sequential(nn.Linear(size, 128), nn.Tanh(), nn.Linear(128, 128), nn.Tanh(), head)
            for head in heads
        )
        self.log_deviation = nn.Parameter(torch.full((3,), -1.5))

    def forward(self, state: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
        """Return mean actions (N, 3) of -1 to 1 for states (N, 12) and images (N, H, W)."""
        return self.actor(network_input(state, image))


def network_input(state: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
    """Return the input of both networks (N, 12 + H W), scaled to about one."""
    return torch.cat([SCALE * state, 0.3 * image.flatten(1)], 1)


def tensors(observation: dict[str, np.ndarray]) -> torch.Tensor:
    """Return the observation of all environments as the input of the networks."""
    state, image = torch.as_tensor(observation["state"]), torch.as_tensor(observation["image"])
    return network_input(state, image)


def main(out: Path, minutes: float, envs: int = 128, steps: int = 24) -> Path:
    """Train for some minutes, and return the path of the exported policy."""
    torch.manual_seed(0)
    torch.set_num_threads(1)  # the networks are small
    race = gymnasium.make_vec(ID, num_envs=envs, spec=SPEC)  # tracks: random at level 0
    agent = Agent()
    optimizer = torch.optim.Adam(agent.parameters(), 5e-4, eps=1e-5)
    now, total, end = tensors(race.reset(seed=0)[0]), 0, time.monotonic() + 60.0 * minutes
    while True:
        x, actions = torch.zeros(steps, *now.shape), torch.zeros(steps, envs, 3)
        rewards, over = torch.zeros(2, steps, envs)
        gates: list[int] = []
        for t in range(steps):
            x[t] = now
            with torch.no_grad():
                actions[t] = Normal(agent.actor(now), agent.log_deviation.exp()).sample()
            observation, reward, terminated, truncated, info = race.step(actions[t].numpy())
            ended = terminated | truncated
            for k in np.flatnonzero(ended):
                gates.append(int(info["final_info"]["gates"][k]))
                if truncated[k]:  # bootstrap from the value of the last observation
                    last = {key: part[None] for key, part in info["final_obs"][k].items()}
                    with torch.no_grad():
                        reward[k] += GAMMA * float(agent.critic(tensors(last)))
            now, over[t] = tensors(observation), torch.tensor(ended)
            rewards[t] = torch.tensor(reward)
        with torch.no_grad():
            value = agent.critic(torch.cat([x, now[None]]))[..., 0]
            before = Normal(agent.actor(x), agent.log_deviation.exp()).log_prob(actions).sum(-1)
        advantage, later = torch.zeros(steps, envs), torch.zeros(envs)
        for t in reversed(range(steps)):
            going = 1.0 - over[t]
            error = rewards[t] + GAMMA * going * value[t + 1] - value[t]
            advantage[t] = later = error + GAMMA * LAMBDA * going * later
        goal = advantage + value[:-1]
        flat = [part.flatten(0, 1) for part in (x, actions, before, advantage, goal)]
        for rows in (
            r for _ in range(EPOCHS) for r in torch.randperm(steps * envs).chunk(MINIBATCHES)
        ):
            inputs, action, old, gain, target = (part[rows] for part in flat)
            gain = (gain - gain.mean()) / (gain.std() + 1e-8)
            log = Normal(agent.actor(inputs), agent.log_deviation.exp()).log_prob(action).sum(-1)
            ratio = (log - old).exp()
            policy = -torch.minimum(ratio * gain, ratio.clamp(1 - CLIP, 1 + CLIP) * gain).mean()
            loss = policy + 0.5 * ((agent.critic(inputs)[:, 0] - target) ** 2).mean() / goal.var()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            optimizer.step()
        total += steps * envs
        print(f"{total} decisions: {np.mean(gates or [0]):.2f} gates of {len(gates)} episodes")
        if time.monotonic() > end:
            break
    out.mkdir(parents=True, exist_ok=True)
    return export_module(agent, out / "policy.onnx", race.contract)  # pyrefly: ignore[missing-attribute]


if __name__ == "__main__":
    main(Path(sys.argv[1]), float(sys.argv[2]) if sys.argv[2:] else 25.0)
