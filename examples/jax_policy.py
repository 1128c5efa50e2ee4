"""Judge a policy that is a Python function in memory, such as one of rsl_rl or brax.

The function here accelerates towards the next gate, and adds a small JAX network with random
weights. Run: python examples/jax_policy.py [TRIALS]
"""

from __future__ import annotations

import sys

import jax
import jax.numpy as jnp
import numpy as np

from policies.block_policy import BlockPolicy, verify_rows
from policies.spec import ActionSpec, PolicySpec
from suite import evaluate_policy

SPEC = PolicySpec(rate_hz=50.0, action=ActionSpec(scale=(20.0,), clip=1.0))  # actions -1 to 1


def network(weights: jax.Array, state: jax.Array, image: jax.Array) -> jax.Array:
    """Return actions (N, 3), -1 to 1, from state (N, 12) and image (N, 24, 32)."""
    vel_b, gate_b = state[:, 0:3], state[:, 6:9]
    direction_b = gate_b / jnp.maximum(jnp.linalg.norm(gate_b, axis=-1, keepdims=True), 0.1)
    from_image = jnp.tanh(image.reshape(len(image), -1) @ weights)
    return (2.5 * direction_b - vel_b) / 10.0 + 0.01 * from_image


def main(trials: int) -> None:
    """Fly the function in the judge and print the results."""
    weights = 0.01 * jax.random.normal(jax.random.key(0), (24 * 32, 3))
    compiled = jax.jit(lambda state, image: network(weights, state, image))

    def model(
        state: np.ndarray, image: np.ndarray, hidden: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        return np.asarray(compiled(state, image)), hidden  # (0,) hidden: without memory

    policy = verify_rows(BlockPolicy("jax", SPEC, model, (0,)), "jax_policy")
    results = evaluate_policy(
        policy, track="random", difficulty=0, trials=trials, vehicle="racer5", workers=1
    )
    for result in results:
        print(f"seed {result.seed}: {result.gates_passed} gates, {result.ending}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if sys.argv[1:] else 10)
