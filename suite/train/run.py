"""A training run in a folder: checkpoints that survive a kill, exact resumption, its curve.

The folder holds run.json (what was run), metrics.jsonl (the curve), policy/ (what flies) and
state/ (what resumes). Worlds and noise depend on the seed and the iteration alone, so a resumed
run draws the curve that it would have drawn without the stop.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from eval.sharding import usable_cores
from policies import delta_network, network
from policies.checkpoint import load_arrays, read_config, save_arrays
from policies.policy_file import save_policy
from policies.tree_arrays import tree_from_arrays, tree_to_arrays
from suite.console import Console
from suite.errors import WorkFailed
from suite.estimate import Estimate, announce
from suite.provenance import write_run_record
from suite.train import curve
from suite.train.config import TrainConfig
from suite.train.update import TrainState, device_mesh, make_update, start_state
from suite.train.worlds import sample_worlds
from tracks.files import plain, recover_folder

SAVE_PERIOD_S = 30.0
"""Time between checkpoints [s]."""
STEPS_PER_CORE_S = 5000.0
"""Gradient steps a second that one processor core makes, for the estimate."""
COMPILE_S = 15.0
"""Time to compile, for the estimate [s]."""


@dataclass(frozen=True)
class Outcome:
    """What a run came to."""

    policy: Path
    """The trained policy's checkpoint."""
    iterations: int
    """Gradient steps done, over all stops."""
    last: dict[str, Any]
    """Means over the last tenth of the curve."""


def estimate(config: TrainConfig) -> Estimate:
    """Return about how long a run takes on this machine's devices and what memory it needs."""
    episode = config.episode
    frames = episode.batch * episode.steps
    pixels = config.spec.camera.height * config.spec.camera.width
    on_cpu = jax.default_backend() == "cpu"
    speed = STEPS_PER_CORE_S * usable_cores() if on_cpu else 50 * STEPS_PER_CORE_S
    seconds = COMPILE_S + config.optimizer.iterations * frames / speed
    return Estimate(seconds, 8e8 + frames * (2 * pixels + 24 * config.spec.hidden_size) * 4.0)


def train(
    config: TrainConfig,
    folder: Path,
    console: Console,
    params: network.Params | None = None,
    delta: delta_network.Params | None = None,
) -> Outcome:
    """Train until the configured iterations are done; the same call again resumes.

    Args:
        config: the whole run.
        folder: where it lives; a folder with a run of the same configuration is resumed.
        console: where progress goes.
        params: start from these instead of fresh ones.
        delta: a frozen Delta Action network to train under.

    Raises:
        ValueError: where the folder holds a run of another configuration, start or delta.
        WorkFailed: where the loss or the parameters stop being finite.
    """
    mesh = device_mesh(config)
    origin = {"config": plain(config), "from": _digest(params), "delta": _digest(delta)}
    state = _resume(origin, folder, start_state(config, params))
    # Placed as the update returns it: placed otherwise, the second step would compile it again.
    state = jax.device_put(state, NamedSharding(mesh, PartitionSpec()))
    first, total = int(state.iteration), config.optimizer.iterations
    if first < total:
        announce(console, f"training to {folder}", estimate(config))
        write_run_record(folder, config, config.seed)
        update = make_update(config, mesh, delta)
        state = _iterate(config, origin, folder, console, state, update)
    rows = curve.read(folder)
    last = rows[-max(1, len(rows) // 10) :]
    means = {key: float(np.mean([row[key] for row in last])) for key in last[0]}
    return Outcome(folder / "policy", int(state.iteration), means)


def _digest(params: Mapping[str, Any] | None) -> str | None:
    """Return what tells one network's parameters from another's; None for none."""
    if params is None:
        return None
    digest = hashlib.sha256()
    for name in sorted(params):
        digest.update(name.encode() + np.asarray(params[name], order="C").tobytes())
    return digest.hexdigest()


def _iterate(
    config: TrainConfig,
    origin: dict[str, Any],
    folder: Path,
    console: Console,
    state: TrainState,
    update: Any,
) -> TrainState:
    total, frames = config.optimizer.iterations, config.episode.batch * config.episode.steps
    first = int(state.iteration)
    rows: list[dict[str, Any]] = []
    saved_at = time.monotonic()
    worlds = sample_worlds(config, first)

    def save() -> None:
        curve.append(folder, rows)
        rows.clear()
        _save(config, origin, folder, state)

    try:
        with console.progress("training", total) as show:
            for iteration in range(first, total):
                started = time.monotonic()
                after, numbers = update(state, worlds)
                # The device works meanwhile: prepare the next iteration's worlds.
                worlds = sample_worlds(config, iteration + 1)
                row = {key: float(value) for key, value in numbers.items()}
                _check_finite(iteration, row, folder)
                speed = frames / (time.monotonic() - started)
                # The row comes first: an interrupt between the two leaves one too many, which
                # resuming cuts, and not one too few.
                rows.append({"iteration": iteration, **row, "steps_per_s": round(speed)})
                state = after
                show(iteration + 1, _note(row, speed))
                if time.monotonic() - saved_at > SAVE_PERIOD_S:
                    save()
                    saved_at = time.monotonic()
    finally:
        save()
    return state


def _note(row: dict[str, float], speed: float) -> str:
    return (
        f"loss {row['loss']:.2f}, gates {row['gates']:.2f}, collided {row['collided']:.0%}, "
        f"{row['speed']:.1f} m/s, {speed:.0f} steps/s"
    )


def _check_finite(iteration: int, row: dict[str, float], folder: Path) -> None:
    bad = [key for key, value in row.items() if not math.isfinite(value)]
    if bad:
        raise WorkFailed(
            f"training diverged at iteration {iteration}: {', '.join(bad)} not finite. The last "
            f"finite state is in {folder / 'state'}; lower optimizer.rate or set optimizer.clip"
        )


def _save(config: TrainConfig, origin: dict[str, Any], folder: Path, state: TrainState) -> None:
    described = {**origin, "iteration": int(state.iteration)}
    save_policy(folder / "policy", state.params, config.spec, seed=config.seed, training=described)
    # The state comes last: what it says is done has its policy and its curve on the disk.
    save_arrays(
        folder / "state",
        tree_to_arrays(state),
        kind="training",
        seed=config.seed,
        extra={"training": described},
    )


def _resume(origin: dict[str, Any], folder: Path, fresh: TrainState) -> TrainState:
    place = folder / "state"
    recover_folder(place)
    if not place.exists():
        folder.mkdir(parents=True, exist_ok=True)
        curve.cut(folder, 0)
        return fresh
    theirs = read_config(place)["training"]
    options = [f"--{key}" for key in ("from", "delta") if theirs.get(key) != origin[key]]
    settings = [k for k, v in origin["config"].items() if theirs["config"].get(k) != v]
    if options or settings:
        raise ValueError(
            f"{folder} holds another run (it differs in {', '.join(options + settings)}); "
            "give another --out, or remove the folder to start over"
        )
    stored = load_arrays(place, kind="training")
    state = jax.tree.map(jnp.asarray, tree_from_arrays(fresh, stored.arrays, str(place)))
    curve.cut(folder, int(state.iteration))
    return state
