"""`suite bench env`: decisions a second of one vector environment against single ones in a loop."""

from __future__ import annotations

import numpy as np

from suite.experiments.bench.compare import Comparison, compared, in_turn

ENVS, DECISIONS = 64, 20
"""Environments, and decisions of each that are timed at once."""


def run(envs: int = ENVS, decisions: int = DECISIONS, repeats: int = 3) -> Comparison:
    """Step both with images and the same actions; an environment whose episode ends is reset."""
    from eval.envs.gymnasium_env import RaceEnv, RaceVectorEnv

    many = RaceVectorEnv(envs, track="random")
    singles = [RaceEnv(track="random") for _ in range(envs)]
    many.reset(seed=0)
    for number, env in enumerate(singles):
        env.reset(seed=number)
    rng = np.random.default_rng(0)
    actions = (0.1 * rng.standard_normal((decisions, envs, 3))).astype(np.float32)

    def ours() -> None:
        for action in actions:
            many.step(action)

    def baseline() -> None:
        for action in actions:
            for env, own in zip(singles, action, strict=True):
                _, _, terminated, truncated, _ = env.step(own)
                if terminated or truncated:
                    env.reset()

    taken = in_turn({"ours": ours, "baseline": baseline}, repeats)
    details = {"environments": envs, "image": "24 x 32", "vehicle": "racer5"}
    return compared("env", taken, envs * decisions, "decisions/s", details)
