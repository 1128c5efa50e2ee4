"""The Delta Action network as a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from policies.formats.checkpoint import WEIGHTS, check_shapes, load_arrays, save_arrays

KIND = "delta"


@dataclass(frozen=True)
class DeltaCheckpoint:
    """A Delta Action network as it was stored."""

    params: dict[str, np.ndarray]
    """The network's parameters, float32, as `delta_network.init` names and shapes them."""
    config: dict[str, Any]
    """The whole of config.json, "fit" among it."""


def save_delta(
    folder: Path,
    params: Mapping[str, Any],
    *,
    seed: int | None,
    fit: Mapping[str, Any] | None = None,
) -> Path:
    """Write a Delta Action network; a kill at any moment leaves the old one or the new one.

    Args:
        folder: the checkpoint's folder.
        params: the network's parameters.
        seed: the fit's seed.
        fit: the resolved configuration and results of the fit.

    Returns:
        `folder`.

    Raises:
        OSError: where the disk refuses; what was there stays.
    """
    return save_arrays(folder, params, kind=KIND, seed=seed, extra={"fit": dict(fit or {})})


def load_delta(folder: Path) -> DeltaCheckpoint:
    """Read a Delta Action network.

    Raises:
        PolicyError: where the checkpoint is damaged, of another kind, not finite, or its arrays
            are not the network's.
    """
    import jax

    from policies.networks import delta_network

    stored = load_arrays(folder, kind=KIND)
    shapes = jax.eval_shape(delta_network.init, jax.random.key(0))
    expected = {name: tuple(value.shape) for name, value in shapes.items()}
    check_shapes(folder / WEIGHTS, stored.arrays, expected)
    return DeltaCheckpoint(stored.arrays, stored.config)
