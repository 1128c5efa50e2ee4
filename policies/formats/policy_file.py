"""Our policy as a checkpoint: the network's parameters with the `PolicySpec` they were made for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from policies.errors import PolicyError
from policies.formats.checkpoint import CONFIG, WEIGHTS, check_shapes, load_arrays, save_arrays
from policies.formats.spec_json import spec_from_json, spec_to_json
from policies.spec import PolicySpec, check_network

KIND = "policy"


@dataclass(frozen=True)
class PolicyCheckpoint:
    """A policy as it was stored."""

    params: dict[str, np.ndarray]
    """The network's parameters, float32, as `network.init` names and shapes them."""
    spec: PolicySpec
    """The rate, camera and scaling it was made for."""
    config: dict[str, Any]
    """The whole of config.json, "training" among it."""

    @property
    def seed(self) -> int | None:
        """The seed of its training; None where its maker does not say."""
        return self.config.get("seed")


def save_policy(
    folder: Path,
    params: Mapping[str, Any],
    spec: PolicySpec,
    *,
    seed: int | None,
    training: Mapping[str, Any] | None = None,
) -> Path:
    """Write a policy as a checkpoint; a kill at any moment leaves the old one or the new one.

    Args:
        folder: the checkpoint's folder.
        params: the network's parameters.
        spec: what the policy expects of the world.
        seed: the training's seed.
        training: the resolved training configuration.

    Returns:
        `folder`.

    Raises:
        OSError: where the disk refuses; what was there stays.
    """
    extra = {"spec": spec_to_json(spec), "training": dict(training or {})}
    return save_arrays(folder, params, kind=KIND, seed=seed, extra=extra)


def load_policy_checkpoint(folder: Path) -> PolicyCheckpoint:
    """Read a policy's checkpoint.

    Raises:
        PolicyError: where it is damaged, of another kind, not finite, or its arrays do not have
            the shapes that its spec asks for.
    """
    stored = load_arrays(folder, kind=KIND)
    if "spec" not in stored.config:
        raise PolicyError(f"{folder / CONFIG}: key 'spec' is missing; copy the whole folder again")
    spec = spec_from_json(stored.config["spec"], f"{folder / CONFIG}: spec")
    check_shapes(folder / WEIGHTS, stored.arrays, expected_shapes(spec, str(folder / CONFIG)))
    return PolicyCheckpoint(stored.arrays, spec, stored.config)


def expected_shapes(spec: PolicySpec, where: str) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the network's parameters for a spec.

    Raises:
        PolicyError: where no network of ours has such an image or such channels.
    """
    import jax

    from policies.networks import network

    try:
        check_network(spec)
    except ValueError as error:
        raise PolicyError(f"{where}: {error}") from None
    shapes = jax.eval_shape(lambda key: network.init(key, spec), jax.random.key(0))
    return {name: tuple(value.shape) for name, value in shapes.items()}
