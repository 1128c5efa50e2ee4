"""The benchmark `env`: decisions per second of a vector environment against single ones in a loop.

Both fly 64 races with images; a vector environment steps all of them at once.
"""

from __future__ import annotations

import numpy as np

from suite.experiments.bench.compare import Comparison, compare_times, in_turn


def run(envs: int = 64, decisions: int = 20, repeats: int = 3) -> Comparison:
    """Time `repeats` calls of both, each of `decisions` with the same random actions."""
    from eval.envs.gymnasium_env import RaceEnv, RaceVectorEnv

    vector_env = RaceVectorEnv(envs, track="random")
    singles = [RaceEnv(track="random") for _ in range(envs)]
    vector_env.reset(seed=0)
    for number, env in enumerate(singles):
        env.reset(seed=number)
    rng = np.random.default_rng(0)
    actions = (0.1 * rng.standard_normal((decisions, envs, 3))).astype(np.float32)

    def ours() -> None:
        for step_actions in actions:
            vector_env.step(step_actions)

    def baseline() -> None:
        for step_actions in actions:
            for env, action in zip(singles, step_actions, strict=True):
                _, _, terminated, truncated, _ = env.step(action)
                if terminated or truncated:  # the vector environment does this by itself
                    env.reset()

    times_s = in_turn({"ours": ours, "baseline": baseline}, repeats)
    details = {"environments": envs, "image": "24 x 32", "vehicle": "racer5"}
    return compare_times("env", times_s, envs * decisions, "decisions/s", details)
