"""Save and load checkpoints of the suite's networks: policies and Delta Action Models.

A Delta Action Model is a network that adds a correction to the action, so that simulated flights
match measured ones. A policy is stored with its `PolicySpec` (rate, camera, scaling) and contract.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from policies import contract
from policies.formats.checkpoint import (
    CONFIG,
    WEIGHTS,
    Stored,
    check_shapes,
    load_arrays,
    save_arrays,
)
from policies.formats.spec_json import spec_from_json
from policies.spec import Note, PolicyError, PolicySpec, check_network

POLICY, DELTA = "policy", "delta"
"""Kinds of checkpoint."""


@dataclass(frozen=True)
class PolicyCheckpoint:
    """A policy as it was stored."""

    params: dict[str, np.ndarray]
    """The network's parameters, float32, with the names and shapes of `network.init`."""
    spec: PolicySpec
    """The rate, camera and scaling for which the policy was trained."""
    config: dict[str, Any]
    """The object of config.json; its key "training" has the configuration of the training."""

    @property
    def seed(self) -> int | None:
        """Seed of its training; None where unknown."""
        return self.config.get("seed")

    def notes(self, name: str) -> tuple[Note, ...]:
        """Return a note on the policy `name` if its training was stopped."""
        training = self.config.get("training") or {}
        done, settings = training.get("iteration"), training.get("config") or {}
        total = settings.get("optimizer", {}).get("iterations")
        if done is None or total is None or done >= total:
            return ()
        text = f"{name}: its training was stopped after {done} of {total} gradient steps"
        return (Note("training_unfinished", text, "repeat its suite train command to continue it"),)


def save_policy(
    folder: Path,
    params: Mapping[str, Any],
    spec: PolicySpec,
    *,
    seed: int | None,
    training: Mapping[str, Any] | None = None,
) -> Path:
    """Write a policy as a checkpoint; a kill at any moment leaves the old one or the new one.

    `spec` has the rate, camera and scaling that the policy expects, `training` is the resolved
    configuration.

    Returns:
        `folder`.

    Raises:
        OSError: where the files cannot be written; an existing checkpoint is kept.
    """
    stored_contract = contract.contract_of(spec, (spec.hidden_size,)).to_json()
    extra = {
        "spec": asdict(spec),
        contract.KEY: stored_contract,
        "training": dict(training or {}),
    }
    return save_arrays(folder, params, kind=POLICY, seed=seed, extra=extra)


def load_policy_checkpoint(folder: Path) -> PolicyCheckpoint:
    """Read a policy's checkpoint.

    Raises:
        PolicyError: where it is damaged, of another kind, not finite, its arrays do not have the
            shapes of its spec, or the suite's network does not support such an image.
    """
    from policies.networks import network

    stored = load_arrays(folder, kind=POLICY)
    if "spec" not in stored.config:
        raise PolicyError(f"{folder / CONFIG}: key 'spec' is missing; copy the whole folder again")
    spec = spec_from_json(stored.config["spec"], f"{folder / CONFIG}: spec")
    try:
        check_network(spec)
    except ValueError as error:
        raise PolicyError(f"{folder / CONFIG}: {error}") from None
    check_shapes(folder / WEIGHTS, stored.arrays, _shapes(network.init, spec))
    if contract.KEY in stored.config:
        where, expected = f"{folder / CONFIG}: {contract.KEY}", contract.contract_of(spec)
        stored_contract = contract.read_contract(stored.config[contract.KEY], where)
        contract.refuse_differences(stored_contract, expected, where, "the spec in the same file")
    return PolicyCheckpoint(stored.arrays, spec, stored.config)


def load_delta(folder: Path) -> Stored:
    """Read a Delta Action network; key "fit" of its config has the fit's configuration and results.

    Args:
        folder: the checkpoint's folder, or the folder of a `suite delta`, which has it as delta/.

    Raises:
        PolicyError: where the checkpoint is damaged, of another kind, not finite, or its arrays
            do not have the names and shapes of the network's parameters.
    """
    from policies.networks import delta_network

    folder = folder / DELTA if (folder / DELTA).is_dir() else folder
    if not (folder / CONFIG).exists() and (folder / POLICY / CONFIG).exists():
        raise PolicyError(
            f"{folder}: the folder of a training, which has a policy and no Delta Action Model; "
            "give the folder that suite delta wrote"
        )
    stored = load_arrays(folder, kind=DELTA)
    check_shapes(folder / WEIGHTS, stored.arrays, _shapes(delta_network.init))
    return stored


def _shapes(init: Callable[..., dict[str, Any]], *args: Any) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the parameters that `init(key, *args)` makes."""
    import jax

    shapes = jax.eval_shape(lambda key: init(key, *args), jax.random.key(0))
    return {name: tuple(value.shape) for name, value in shapes.items()}
