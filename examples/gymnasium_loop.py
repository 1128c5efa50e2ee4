"""Fly races in a `gymnasium.Env`, the interface of many reinforcement-learning libraries.

The pilot is a line of code that accelerates towards the next gate. Run: python
examples/gymnasium_loop.py [EPISODES]
"""

from __future__ import annotations

import sys

import numpy as np

from eval.envs.race import ACTION_LIMIT
from suite import make_env


def pilot(state: np.ndarray) -> np.ndarray:
    """Return the action (3,), a share of ACTION_LIMIT, from the paper's 12 numbers."""
    vel_b, gate_b = state[0:3], state[6:9]  # velocity [m/s], the next gate's centre [m], body axes
    desired_vel_b = 2.5 * gate_b / max(float(np.linalg.norm(gate_b)), 0.1)
    return np.clip(2.0 * (desired_vel_b - vel_b) / ACTION_LIMIT, -1.0, 1.0).astype(np.float32)


def main(episodes: int) -> None:
    """Fly episodes, each on another track, and print how each ended."""
    env = make_env(track="circular", level=0)
    observation, info = env.reset(seed=1)
    for _ in range(episodes):
        total, steps, over = 0.0, 0, False
        while not over:
            action = pilot(observation["state"])
            observation, reward, terminated, truncated, info = env.step(action)
            total, steps, over = total + float(reward), steps + 1, terminated or truncated
        depth = observation["image"]  # (24, 32) encoded inverse depth
        print(
            f"{info['gates']} gates, {info['ended_by']} after {steps} decisions, return {total:.1f}"
            f", nearest pixel {depth.max():.2f}"
        )
        observation, info = env.reset()  # another track; options={"track_seed": 5} selects one
    env.close()


if __name__ == "__main__":
    main(int(sys.argv[1]) if sys.argv[1:] else 5)
