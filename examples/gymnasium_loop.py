"""Race in a `gymnasium.Env`, for learners that come from elsewhere.

The pilot here is a line of code that pulls to the next gate. Run: python
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
    wanted_b = 2.5 * gate_b / max(float(np.linalg.norm(gate_b)), 0.1)
    return np.clip(2.0 * (wanted_b - vel_b) / ACTION_LIMIT, -1.0, 1.0).astype(np.float32)


def main(episodes: int) -> None:
    """Fly episodes on tracks of their own and print how each ended."""
    env = make_env(track="circular", level=0)
    seen, info = env.reset(seed=1)
    for _ in range(episodes):
        total, steps, over = 0.0, 0, False
        while not over:
            seen, reward, terminated, truncated, info = env.step(pilot(seen["state"]))
            total, steps, over = total + float(reward), steps + 1, terminated or truncated
        depth = seen["image"]  # (24, 32) encoded inverse depth, the policies' input
        print(
            f"{info['gates']} gates, {info['ended_by']} after {steps} decisions, return {total:.1f}"
            f", nearest pixel {depth.max():.2f}"
        )
        seen, info = env.reset()  # another track; options={"track_seed": 5} selects one
    env.close()


if __name__ == "__main__":
    main(int(sys.argv[1]) if sys.argv[1:] else 5)
