"""Judged trials flown in the trainer's dynamics as well: where a policy's failures come from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from eval.quadrotor.vehicle_file import load_vehicle
from eval.vehicles.vehicle import Vehicle
from eval.worlds.trial import Rules, TrialSpec
from policies import shipped
from policies.formats.policy_file import load_policy_checkpoint
from policies.networks import network
from policies.spec import PolicySpec
from suite.common.console import Console
from suite.common.report import Report, Section
from suite.experiments.pages.document import Place
from suite.experiments.pages.transfer import (
    JUDGE,
    POINT,
    QUADROTOR,
    Row,
    by_source,
    cells,
    lead,
    overall,
    source_words,
)
from suite.experiments.study import judging, options
from suite.experiments.study.validation import scored, stored_params, validation_worlds
from suite.judging.flying import default_policy
from suite.train.config import PointMassConfig, QuadrotorConfig, TrainConfig
from suite.train.dynamics.interface import DynamicsState
from suite.train.rollout import make_rollout
from suite.train.step import BODY_RADIUS_M
from suite.train.worlds import Worlds, sample_worlds
from tracks.families import MAX_COUNTS, make_track
from tracks.geometry.scene import stack
from tracks.input.ranges import Seed, Trials

NOMINAL = PointMassConfig(
    lag_std=0.0,
    drag=(0.3, 0.3),
    drag_up=(0.9, 0.9),
    wind_std=(0.0, 0.0, 0.0),
    time_step_std=0.0,
    depth_noise=0.0,
    fov_scale=(1.0, 1.0),
)
"""A point mass without randomisation, much as `reference` flies; and the images of both."""
DELAY_S = 1 / 30
"""Of the point mass's commands [s]."""
AT_ONCE = 100
"""Trials flown as one batch, at most: more would be no faster, and the memory grows with them."""
MEANINGS = (
    f"{POINT}: the trainer's, with a lag of {NOMINAL.lag_mean:g} 1/s, drag of 0.3, 0.3 and 0.9 "
    f"1/s, commands {1000 * DELAY_S:.0f} ms late (at most two decisions), and nothing drawn. "
    f"{QUADROTOR}: the trainer's, of the judged vehicle with its effects, in single precision and "
    "fewer, longer steps. Both end a trial by the trainer's collisions, of a sphere of "
    f"{BODY_RADIUS_M:g} m where the judge has the vehicle's box, and show the nearest solids of "
    "each kind alone; the point mass is the same for every vehicle and cannot tip over, and the "
    "quadrotor is looked at for that where a decision ends, not in every step. "
    f"{JUDGE}: MuJoCo. Minus {JUDGE}: on the same trials, in points, with Newcombe's paired 95 % "
    "interval."
)


@dataclass(frozen=True)
class Config:
    """Fly judged trials in the trainer's point mass and quadrotor as well, side by side."""

    policy: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A shipped policy's name or a checkpoint's folder; may be given several times. Without it the
    shipped policy flies."""
    difficulty: str = "0,3,6,9"
    """Level, 0 (easy) to 9 (hard); several as 0,3,9 or 0-3 or all."""
    trials: Trials = 100
    """Trials of every policy on every track at every level in each dynamics."""
    seed: Seed = 0
    """Seed of the first trial; the others follow by one."""
    vehicle: str = "reference"
    """A shipped vehicle's name or a vehicle file (.toml)."""


def document(config: Config, place: Place, console: Console) -> tuple[Report, dict[str, Any]]:
    """Return the page and its numbers; what the judge has not flown is flown first.

    Raises:
        PolicyError: for a policy that is no checkpoint of ours.
    """
    vehicle = load_vehicle(config.vehicle)
    policies = judging.named_policies(config.policy or (default_policy(),))
    specs = {name: load_policy_checkpoint(shipped.locate(p)).spec for name, p in policies.items()}
    trials = judging.trials_of(config)
    orders = {
        name: judging.Order(judging.Flier(policy, vehicle), trials)
        for name, policy in policies.items()
    }
    judged = judging.flown(orders, place.cache, console, "judging", place.workers)
    rows: dict[str, list[Row]] = {}
    for name, policy in policies.items():
        won = {
            kind: trainer_wins(policy, made(specs[name], vehicle), trials, console)
            for kind, made in TRAINERS.items()
        }
        columns = won[POINT], won[QUADROTOR], [result.success for result in judged[name]]
        rows[name] = [
            Row(trial, *map(bool, each)) for trial, *each in zip(trials, *columns, strict=True)
        ]
    report = Report(
        title="Transfer: judged trials in the trainer's dynamics",
        lead=lead(rows),
        facts={
            **judging.policy_facts(policies),
            "trials": f"three tracks, levels {config.difficulty}, seeds "
            f"{options.judged_seeds(config)}: {len(trials)} of each policy in each dynamics",
            "vehicle": config.vehicle,
        },
        sections=[
            Section("Side by side", [overall(rows), MEANINGS]),
            Section("Every cell", [cells(rows)]),
            Section("Where failures come from", [by_source(rows), source_words()]),
        ],
    )
    return report, {
        "trials": {
            name: [{**row._asdict(), "source": row.source} for row in mine]
            for name, mine in rows.items()
        }
    }


def point_recipe(spec: PolicySpec, _: Vehicle) -> TrainConfig:
    """Return what flies as the point mass without randomisation."""
    delay = min(2.0, DELAY_S * spec.rate_hz)
    physics = replace(NOMINAL, action_delay=(delay, delay), rays=spec.camera.rays)
    return TrainConfig(spec=spec, physics=physics)


def quadrotor_recipe(spec: PolicySpec, vehicle: Vehicle) -> TrainConfig:
    """Return what flies as the trainer's quadrotor of `vehicle`, without randomisation."""
    exact = QuadrotorConfig(
        vehicle,
        mass_std=0.0,
        lag_spread=0.0,
        drag_spread=0.0,
        delay_spread_s=0.0,
        gain_spread=0.0,
        wind_std=(0.0, 0.0, 0.0),
    )
    physics = replace(NOMINAL, rays=spec.camera.rays)
    return TrainConfig(spec=spec, physics=physics, quadrotor=exact)


TRAINERS: Mapping[str, Callable[[PolicySpec, Vehicle], TrainConfig]] = {
    POINT: point_recipe,
    QUADROTOR: quadrotor_recipe,
}
"""What flies besides the judge's quadrotor."""


def trainer_wins(
    policy: str,
    recipe: TrainConfig,
    trials: Sequence[TrialSpec],
    console: Console,
) -> list[bool]:
    """Return which trials a policy wins in the dynamics of `recipe`.

    Args:
        policy: a shipped policy's name or a checkpoint's folder.
        recipe: its dynamics.
        trials: on families' tracks.
        console: where progress goes.
    """
    limit = Rules().time_limit_s
    at_once = min(len(trials), AT_ONCE)
    config = validation_worlds(recipe, at_once, 0, limit)
    params, fly = stored_params(shipped.locate(policy)), make_judged_flight(config)
    drawn = sample_worlds(config, 0)
    won: list[bool] = []
    flown = QUADROTOR if config.quadrotor is not None else POINT
    with console.progress(f"flying in the trainer's {flown}", len(trials)) as update:
        for first in range(0, len(trials), at_once):
            some = list(trials[first : first + at_once])
            # The last batch is filled up, so that it is not compiled anew.
            filled = some + some[-1:] * (at_once - len(some))
            worlds = judged_worlds(drawn, config.spec, filled)
            wins = np.asarray(fly(params, jax.tree.map(jnp.asarray, worlds))).tolist()
            won += wins[: len(some)]
            update(len(won))
    return won


def judged_worlds(drawn: Worlds, spec: PolicySpec, trials: Sequence[TrialSpec]) -> Worlds:
    """Return the trials' tracks as worlds: from their start, asked for the policy's speed.

    Args:
        drawn: as many worlds, from rest, that have the constants of the dynamics.
        spec: of the policy.
        trials: on families' tracks.
    """
    tracks = [make_track(*trial) for trial in trials]
    yaw = np.array([track.start_yaw for track in tracks])
    heading_w = np.stack([np.cos(yaw), np.sin(yaw), 0.0 * yaw], -1)
    return drawn._replace(
        scene=stack([track.scene for track in tracks], MAX_COUNTS),
        pos_w=np.stack([track.start_pos_w for track in tracks]).astype(np.float32),
        heading_w=heading_w.astype(np.float32),
        wanted=np.full(len(trials), spec.speed, np.float32) if spec.speed_input else None,
    )


def _up(_: Worlds, __: DynamicsState, after: DynamicsState, ___: jax.Array) -> jax.Array:
    return after.rot_w[:, 2, 2]


def make_judged_flight(config: TrainConfig) -> Callable[[network.Params, Worlds], jax.Array]:
    """Return fly(params, worlds) -> success (B,) bool by the trainer's collisions.

    A quadrotor that tips over has failed, as by the judge's rules; a point mass cannot.
    """
    rollout, episode = make_rollout(config, _up), config.episode

    @jax.jit
    def fly(params: network.Params, worlds: Worlds) -> jax.Array:
        still = jnp.zeros((episode.steps, episode.batch, config.spec.hidden_size))
        key = jax.random.key(np.uint32(config.seed))
        _, records, _ = rollout(params, still, worlds, key, network.encode)
        tipped = (records.noted < 0.0) & (config.quadrotor is not None)
        clearance = jnp.where(tipped, -jnp.inf, records.clearance)
        gates = worlds.scene.gates.center_w.shape[1]
        return scored(records.passed, clearance, records.speed, gates).crossed

    return fly
