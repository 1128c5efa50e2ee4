"""Draw the worlds of one training iteration with numpy: tracks, start states, parameters.

A world is one simulated scene and drone; a batch has B worlds. They depend only on the settings and
the iteration. So a resumed run has the same ones, and `WorldsAhead` samples the worlds of later
iterations while the devices compute the present one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from itertools import islice
from typing import NamedTuple

import jax
import numpy as np

from eval.sensors import SENSORS, view_models
from eval.sensors.interface import Draws, blank_draws, draw
from suite.train.config import TrainConfig
from suite.train.dynamics import interface as dynamics
from suite.train.dynamics import point_mass
from tracks.common.work import usable_cores
from tracks.common.work.processes import worker_pool
from tracks.families import MAX_COUNTS, random_track
from tracks.families.random import Mix
from tracks.geometry.bounds import Bounds, bounds
from tracks.geometry.scene import Array, Scene, stack
from tracks.track import Track, first_gates

START_DRAWS, START_CLEARANCE_M, START_HEIGHT_M = 6, 0.5, 0.4
"""Limits of the search for a start point between gates: the largest number of draws, the clearance
at which the search ends [m], and the lowest height of the point [m]."""


class Sensed(NamedTuple):
    """Random numbers of the sensor models in a batch of worlds, by the models' names."""

    magnitude: dict[str, Array]
    """(B,) factor on the model's errors: 0 is a perfect sensor, 1 has the values of the sensors
    file."""
    trial: dict[str, Draws]
    """(B, ...) random numbers that a model needs once per flight."""


class Worlds(NamedTuple):
    """A batch of worlds, (B, ...)."""

    scene: Scene
    """Gates and obstacles of the tracks."""
    pos_w: Array
    """(B, 3) position at the start [m]."""
    vel_w: Array
    """(B, 3) velocity at the start [m/s]."""
    heading_w: Array
    """(B, 3) heading at the start, horizontal unit vectors."""
    target: Array
    """(B,) index of the gate that is passed next."""
    constants: dynamics.WorldParams
    """Parameters of the dynamics."""
    hidden: Array
    """(B, hidden) the policy's recurrent state at the start, zero for worlds that start at rest."""
    remembers: Array
    """(B,) 1 if a world starts between two gates, with a recurrent state from an earlier
    rollout."""
    stop: Array
    """(B,) number of the step from which a world no longer counts in the loss."""
    number: Array
    """(B,) number of the world in the batch. Its noise depends on it, and not on the device."""
    fov_scale: Array
    """(B,) factor on the tangents of the half field of view, the same in all worlds of an
    iteration."""
    speed_command: Array | None = None
    """(B,) the commanded speed, 0 to 1, if the policy has that input; else None."""
    sensed: Sensed | None = None
    """Random numbers of the sensor models, if there are any."""


def _clearance(track: Track, point_w: np.ndarray) -> float:
    """Return a lower bound of the distance from a point to the obstacles without gate frames [m].

    It is the distance to the spheres around the obstacles.
    """
    # The boxes of a scene begin with the bars of the gates' frames, which are left out.
    bars = track.scene.gates.opening_g.shape[0] * track.scene.gates.opening_g.shape[1]
    spheres = bounds(track.scene)
    spheres["boxes"] = Bounds(*(field[bars:] for field in spheres["boxes"]))
    offset_w = np.concatenate([ball.center_w for ball in spheres.values()]) - point_w
    radius = np.concatenate([ball.radius for ball in spheres.values()])
    return float((np.linalg.norm(offset_w, axis=-1) - radius).min(initial=np.inf))


def _draw_free_point(
    track: Track, rng: np.random.Generator, draw_point: Callable[[int], np.ndarray]
) -> tuple[np.ndarray, int]:
    """Return a start point (3,) away from obstacles [m], and the index of its next gate.

    Up to `START_DRAWS` gates and points are drawn. The first point with a clearance of
    `START_CLEARANCE_M` is taken, or the one with the largest clearance. `draw_point` maps the index
    of the next gate to a random point (3,) [m].
    """
    # Clearance, point and next gate of the best point so far.
    best = (-np.inf, track.start_pos_w, 0)
    for _ in range(START_DRAWS):
        target = int(rng.integers(0, len(track.scene.gates.center_w)))
        point_w = draw_point(target)
        point_w[2] = max(point_w[2], START_HEIGHT_M)
        clearance = _clearance(track, point_w)
        if clearance > best[0]:
            best = (clearance, point_w, target)
        if clearance > START_CLEARANCE_M:
            break
    return best[1], best[2]


def _start_between_gates(
    track: Track, speed_limit: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, int]:
    """Return position [m], velocity [m/s] and next gate (index) of a drone between two gates."""
    center_w = track.scene.gates.center_w

    def draw_point(target: int) -> np.ndarray:
        previous_w = track.start_pos_w if target == 0 else center_w[target - 1]
        share = rng.uniform(0.1, 0.7)
        return previous_w + share * (center_w[target] - previous_w) + rng.normal(0, 0.25, 3)

    point_w, target = _draw_free_point(track, rng, draw_point)
    to_gate = center_w[target] - point_w
    to_gate = to_gate / max(np.linalg.norm(to_gate), 1e-6)
    sideways = rng.normal(0, 0.25, 3)
    return point_w, rng.uniform(0, speed_limit) * (to_gate + sideways), target


def _start_after_a_miss(
    track: Track, speed_limit: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, int]:
    """Return position [m], velocity [m/s] and next gate (index) of a drone that has missed it."""
    gates = track.scene.gates

    def draw_point(target: int) -> np.ndarray:
        angle, radius_g = rng.uniform(-np.pi, np.pi), rng.uniform(0.9, 1.8)
        point_g = np.array(
            [rng.uniform(-0.7, 1.2), radius_g * np.cos(angle), radius_g * np.sin(angle)]
        )
        return gates.center_w[target] + gates.rot_w[target] @ point_g

    point_w, target = _draw_free_point(track, rng, draw_point)
    onward = rng.uniform(0, 0.4) * gates.rot_w[target, :, 0] + rng.normal(0, 0.08, 3)
    return point_w, speed_limit * onward, target


def _draw_constants(
    config: TrainConfig, iteration: int, rng: np.random.Generator
) -> dynamics.WorldParams:
    """Return the parameters of the dynamics, (B, ...), of an iteration.

    Quadrotors have a separate random generator. The parameters of point masses are drawn in any
    case, so that the later numbers of `rng` are the same for both models.
    """
    physics, batch, period = config.physics, config.episode.batch, 1.0 / config.spec.rate_hz
    stretch = np.clip(1 + physics.time_step_std * rng.standard_normal(batch), 0.5, 1.5)
    low_drag, high_drag = np.transpose([physics.drag, physics.drag, physics.drag_up])
    lag = physics.lag_mean + physics.lag_std * rng.standard_normal(batch)
    point = point_mass.PointMassParams(
        lag=np.clip(lag, 0.2 * physics.lag_mean, None),
        drag=rng.uniform(low_drag, high_drag, (batch, 3)),
        wind_w=rng.standard_normal((batch, 3)) * np.asarray(physics.wind_std),
        time_step=period * stretch,
        delay=rng.uniform(*physics.action_delay, batch),
    )
    if config.quadrotor is None:
        return point_mass.PointMassParams(*(np.asarray(x, np.float32) for x in point))
    # Imported here, so that training through the point mass does not load the judge's physics.
    from suite.train.dynamics.quadrotor import QuadrotorParams, draw_effects

    quadrotor_rng = np.random.default_rng([config.seed, iteration, 1])
    effects = draw_effects(config.quadrotor, batch, quadrotor_rng)
    return QuadrotorParams(np.full(batch, period, np.float32), effects)


def _draw_speed_commands(config: TrainConfig, iteration: int) -> Array | None:
    """Return the commanded speeds (B,), 0 to 1; None for a policy without this input.

    A separate random generator draws them, so that the other numbers do not depend on the input.
    """
    if not config.spec.speed_input:
        return None
    rng = np.random.default_rng([config.seed, iteration, 3])
    batch = config.episode.batch
    races = rng.random(batch) < config.episode.race_share
    return np.where(races, 1.0, rng.random(batch)).astype(np.float32)


def _draw_sensors(config: TrainConfig, iteration: int) -> Sensed | None:
    """Return the random numbers of the sensor models; None without models.

    A separate random generator draws them, so that the other numbers do not depend on the models.
    """
    if config.sensors is None:
        return None
    rng, batch = np.random.default_rng([config.seed, iteration, 4]), config.episode.batch
    camera, magnitude, trial = config.spec.camera, dict[str, Array](), dict[str, Draws]()
    perfect = rng.random(batch) < config.sensors.perfect_share
    for name in config.sensors.seen.models:
        drawn = rng.uniform(*config.sensors.magnitude, batch)
        magnitude[name] = np.where(perfect, 0.0, drawn).astype(np.float32)
    for name in view_models(config.sensors.seen.models):
        blank = blank_draws(SENSORS[name].trial, batch, camera)
        for row in range(batch):
            draw(blank, row, rng)
        trial[name] = Draws(*(numbers.astype(np.float32) for numbers in blank))
    return Sensed(magnitude, trial)


def sample_worlds(config: TrainConfig, iteration: int) -> Worlds:
    """Return the B worlds of an iteration."""
    # The order of the draws below must stay: it determines the tracks of a seed.
    rng = np.random.default_rng([config.seed, iteration])
    episode, batch = config.episode, config.episode.batch
    tracks, starts = [], []
    rests = rng.uniform(size=batch) < episode.rest_share
    mix = Mix(
        sharp_share=episode.sharp_share,
        density=episode.density,
        bare_share=episode.bare_share,
        hairpin_share=episode.hairpin_share,
        height_spread=episode.height_spread,
    )
    for rest in rests:
        drawn = random_track(rng.uniform(*episode.difficulty), rng, mix)
        track = first_gates(drawn, episode.gates)
        tracks.append(track)
        if rest:
            starts.append((track.start_pos_w, np.zeros(3), 0))
        elif episode.missed_share > 0 and rng.random() < episode.missed_share:
            starts.append(_start_after_a_miss(track, episode.start_speed, rng))
        else:
            starts.append(_start_between_gates(track, episode.start_speed, rng))
    pos, vel, target = (np.stack(column) for column in zip(*starts, strict=True))
    gate = np.stack([t.scene.gates.center_w[i] for t, i in zip(tracks, target, strict=True)])
    yaw = np.arctan2(gate[:, 1] - pos[:, 1], gate[:, 0] - pos[:, 0]) + rng.normal(0, 0.2, batch)
    constants = _draw_constants(config, iteration, rng)
    first_stop = max(1, round(episode.stop_from * episode.steps))
    return Worlds(
        scene=stack([track.scene for track in tracks], MAX_COUNTS),
        pos_w=pos.astype(np.float32),
        vel_w=vel.astype(np.float32),
        heading_w=np.stack([np.cos(yaw), np.sin(yaw), np.zeros(batch)], -1).astype(np.float32),
        target=target.astype(np.int32),
        constants=constants,
        hidden=np.zeros((batch, config.spec.hidden_size), np.float32),
        remembers=np.where(rests, 0.0, 1.0).astype(np.float32),
        stop=np.where(rests, rng.integers(first_stop, episode.steps + 1, batch), episode.steps),
        number=np.arange(batch, dtype=np.int32),
        fov_scale=np.full(batch, rng.uniform(*config.physics.fov_scale), np.float32),
        speed_command=_draw_speed_commands(config, iteration),
        sensed=_draw_sensors(config, iteration),
    )


class WorldsAhead:
    """Samples the worlds of later iterations in the background; a context manager.

    If the training runs on a CPU, one thread samples, because one core samples faster than the
    other cores train. For an accelerator, which is faster, a process on each further core samples
    the worlds of another iteration.
    """

    def __init__(self) -> None:
        self._depth = 1 if jax.default_backend() == "cpu" else max(2, usable_cores() - 1)

    def __enter__(self) -> WorldsAhead:
        in_thread = self._depth == 1
        self._pool: Executor = ThreadPoolExecutor(1) if in_thread else worker_pool(self._depth)
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def worlds(
        self, sample: Callable[[int], Worlds], first: int, end: int
    ) -> Iterator[tuple[int, Worlds]]:
        """Yield (iteration, its worlds) for the iterations from `first` to `end` - 1.

        `sample` maps the iteration to its worlds; it must be picklable, to run in a process.
        """
        numbers = iter(range(first, end))
        pending = deque(self._pool.submit(sample, k) for k in islice(numbers, self._depth))
        for iteration in range(first, end):
            worlds = pending.popleft().result()
            pending.extend(self._pool.submit(sample, k) for k in islice(numbers, 1))
            yield iteration, worlds
