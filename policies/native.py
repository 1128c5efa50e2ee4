"""Load the suite's checkpoints as `Policy`: the CNN-GRU, compiled by JAX on its default device."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from policies.block_policy import BlockPolicy, verify_rows
from policies.formats.policy_file import load_policy_checkpoint
from policies.networks import network
from policies.spec import PolicySpec


def load_native(folder: Path, name: str) -> BlockPolicy:
    """Return the policy of a checkpoint.

    Raises:
        PolicyError: where the checkpoint is damaged or of another kind.
    """
    checkpoint = load_policy_checkpoint(folder)
    policy = native_policy(checkpoint.params, checkpoint.spec, name)
    return verify_rows(replace(policy, notes=checkpoint.notes(name)), str(folder))


def native_policy(params: Mapping[str, Any], spec: PolicySpec, name: str) -> BlockPolicy:
    """Return the policy of a network with the parameters `params`, unchecked."""
    device_params = jax.tree.map(jax.numpy.asarray, dict(params))
    step = jax.jit(network.step)

    def model(
        state: np.ndarray, image: np.ndarray, hidden: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        # Accelerators use fewer bits by default; full precision gives equal flights on all devices.
        with jax.default_matmul_precision("highest"):
            action, next_hidden = step(device_params, hidden, state, image)
        return np.asarray(action), np.asarray(next_hidden)

    return BlockPolicy(name, spec, model, (spec.hidden_size,))
