"""The benchmark `train`: trained decisions per second against a plain torch-eager loop.

Both sides make whole gradient steps (rollout, gradient, AdamW) on the same worlds with the recipe
`paper`, whose drones are point masses. A gradient step with a quadrotor instead, randomised as in
the recipe `race`, is timed too.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from suite.experiments.bench.compare import Comparison, Figure, in_turn
from suite.train.config import TrainConfig
from suite.train.recipes import named_recipe
from suite.train.worlds import Worlds, sample_worlds
from tracks.common.work.threads import share_threads
from tracks.geometry.scene import PARKED_Z, Counts, Gates

SOLIDS = Counts(boxes=44, cylinders=8, capsules=6, spheres=6)
"""The 64 solids of every world: 32 bars of the gates' frames, 12 other boxes, 20 round ones."""
BATCH, STEPS, THREADS = 64, 150, 2
"""Worlds, policy periods of a rollout, and threads of both sides."""
UNTRUSTED_BELOW = 2000.0
"""Decisions per second that the baseline reaches at least on two cores without other load; fewer
mean that the machine is too busy for a comparison [1/s]."""
ENOUGH_S = 100.0
"""No further round begins after this time. Two cores without other load finish all rounds earlier
[s]."""


def bench_config(batch: int = BATCH, steps: int = STEPS) -> TrainConfig:
    """Return the recipe `paper` with another number of worlds (`batch`) and of steps."""
    base = named_recipe("paper")
    return replace(base, episode=replace(base.episode, batch=batch, steps=steps))


def bench_worlds(config: TrainConfig) -> Worlds:
    """Return worlds as in a training, but with exactly SOLIDS solids each.

    In a training, solids that a track lacks are "parked" far below the ground. Here they are placed
    at random 1.5 to 4 m from its gates, so that every world costs the same.
    """
    worlds, rng = sample_worlds(config, 0), np.random.default_rng(0)
    scene = worlds.scene
    kinds: dict[str, Any] = {}
    for name in ("boxes", "cylinders", "capsules", "spheres"):
        solids, limit = getattr(scene, name), getattr(SOLIDS, name)
        kinds[name] = type(solids)(*(array[:, :limit].copy() for array in solids))
    for solids in kinds.values():
        is_parked = solids.center_w[..., 2] < PARKED_Z / 2
        solids.center_w[is_parked] = _near_gates(scene.gates, is_parked, rng)
        for name, low, high in (("half_size", 0.05, 0.25), ("radius", 0.1, 0.3)):
            if hasattr(solids, name):
                array = getattr(solids, name)
                array[is_parked] = rng.uniform(low, high, array[is_parked].shape)
        if hasattr(solids, "half_length"):
            solids.half_length[is_parked] = rng.uniform(0.1, 0.8, is_parked.sum())
    return worlds._replace(scene=scene._replace(**kinds, triangles=scene.triangles[:, :0]))


def _near_gates(gates: Gates, missing: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a random point near a gate for each of the N missing solids, (N, 3) [m].

    `missing` is (worlds, solids) bool.
    """
    world, _ = np.nonzero(missing)
    count = len(world)
    center = gates.center_w[world, rng.integers(0, gates.center_w.shape[1], count)]
    angle, radius = rng.uniform(0, 2 * np.pi, count), rng.uniform(1.5, 4.0, count)
    shift = np.stack([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(-1, 1, count)])
    return center + shift.T


def _ours(config: TrainConfig, worlds: Worlds) -> Callable[[], Any]:
    """Return a call that makes one gradient step of the trainer."""
    import jax

    from suite.train.update import make_update, start_state

    update, state = make_update(config), jax.device_put(start_state(config), jax.devices()[0])

    def call() -> Any:
        nonlocal state
        state, numbers = update(state, worlds)
        return jax.block_until_ready((state, numbers))

    return call


def _baseline(config: TrainConfig, worlds: Worlds) -> Callable[[], Any]:
    """Return a call that makes one gradient step of the torch baseline."""
    from suite.experiments.bench.torch_baseline import Baseline, to_torch
    from suite.train.update import start_state

    params = {k: np.asarray(v) for k, v in start_state(config).params.items()}
    baseline, tensors = Baseline(config, params), to_torch(worlds)
    return lambda: baseline.update(tensors)


def run(batch: int = BATCH, steps: int = STEPS, rounds: int = 4) -> Comparison:
    """Time both sides in turn and return the best of all rounds for each."""
    with _two_cores():
        return _compare(batch, steps, rounds)


@contextmanager
def _two_cores() -> Iterator[None]:
    """Limit the process to THREADS cores, and JAX to as many threads."""
    import torch

    torch.set_num_threads(THREADS)
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(allowed)[:THREADS])
    share_threads()
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


def _compare(batch: int, steps: int, rounds: int) -> Comparison:
    """Return the comparison; the shortest time of each side counts."""
    point = bench_config(batch, steps)
    quadrotor = replace(point, quadrotor=named_recipe("race").quadrotor)
    worlds = bench_worlds(point)
    sides = {
        "ours": _ours(point, worlds),
        "baseline": _baseline(point, worlds),
        "quadrotor": _ours(quadrotor, bench_worlds(quadrotor)),
    }
    times_s = in_turn(sides, rounds, most_s=ENOUGH_S)
    rates = {key: batch * steps / min(seconds) for key, seconds in times_s.items()}
    ours, baseline = rates["ours"], rates["baseline"]
    warnings = ()
    if baseline < UNTRUSTED_BELOW:
        warnings = (
            f"the baseline makes {baseline:.0f} decisions/s; two cores without other load make at "
            f"least {UNTRUSTED_BELOW:.0f}. The figures are not reliable, run again without load",
        )
    unit = "decisions/s"
    details = {
        "solids": sum(SOLIDS),
        "batch": batch,
        "steps": steps,
        "quadrotor": {
            "ours": round(rates["quadrotor"]),
            "unit": unit,
            "time_over_point_mass": round(ours / rates["quadrotor"], 2),
        },
        "rounds_s": times_s,
    }
    return Comparison("train", Figure(ours, unit), Figure(baseline, unit), warnings, details)
