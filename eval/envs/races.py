"""Fly N races at once, decision by decision, for the Gymnasium environments.

Each of N slots (places in the simulator) flies one episode, by the rules of the judge, which flies
policies and scores them. A slot's results do not depend on the other slots, to the bit, so one
environment and N environments give the same results.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from numbers import Integral
from types import NoneType
from typing import Any, NamedTuple

import numpy as np

from eval.effects import without_signal
from eval.envs.race import (
    ACTION_LIMIT,
    CRASH_REWARD,
    GATE_REWARD,
    STATE_LIMIT,
    as_actions,
    remaining_path,
    unscaled,
)
from eval.judging.guard import ActionLimits, check_rate, first_action, guard_action, limits_of
from eval.quadrotor.vehicle_file import checked_vehicle, load_vehicle
from eval.vehicles.vehicle import Vehicle
from eval.worlds.engine import course_notes, family_notes, warn_of
from eval.worlds.mujoco import MujocoWorld
from eval.worlds.slots import layout_of
from eval.worlds.trial import ENDINGS, FLYING, Rules, TrialSpec, check_rules, steps_to_next
from policies.contract import Contract, contract_of
from policies.formats.policy_file import load_policy_checkpoint
from policies.observation import View, observe
from policies.shipped import locate, names
from policies.spec import ActionSpec, PolicySpec, check_spec
from tracks.common.names import unknown_name
from tracks.families import LEVELS, check_family, make_track
from tracks.formats.custom import load_track
from tracks.input.ranges import PATH, SEED_MOST, Range, check_number, check_type
from tracks.track import Track

SEEDS = 2**31
"""Number of track seeds, from 0."""
NOT_FINITE = "the action is not finite: look for NaN in the learner's network"
BAD_ACTION = "bad_action"
"""Ending by an action that is not finite, in addition to `eval.worlds.trial.ENDINGS`."""


class Moments(NamedTuple):
    """Quantities of one decision in N episodes, from which reward terms are computed."""

    to_go_before: np.ndarray
    """(N,) length of the remaining path from gate to gate before the decision [m]."""
    to_go: np.ndarray
    """(N,) length of the remaining path after the decision [m]."""
    gates: np.ndarray
    """(N,) number of gates passed during the decision."""
    crashed: np.ndarray
    """(N,) whether the episode ended by a failure other than the time limit."""
    finished: np.ndarray
    """(N,) whether the episode ended with all gates passed."""
    period_s: np.ndarray
    """(N,) time flown during the decision [s]."""
    action_change: np.ndarray
    """(N,) norm of this action minus the last one, both with components from -1 to 1."""


REWARDS: dict[str, tuple[float, Callable[[Moments], np.ndarray]]] = {
    "progress": (1.0, lambda m: m.to_go_before - m.to_go),
    "gate": (GATE_REWARD, lambda m: m.gates),
    "crash": (CRASH_REWARD, lambda m: m.crashed),
    "finish": (0.0, lambda m: m.finished),
    "time": (0.0, lambda m: m.period_s),
    "action_change": (0.0, lambda m: m.action_change),
}
"""Name of a reward term -> its default weight, and the function that computes it."""


@dataclass(frozen=True)
class RaceConfig:
    """Arguments of the environments."""

    track: str | os.PathLike[str] = "random"
    """A track family, or a track file (.toml). The judge evaluates policies on families other than
    `random`."""
    level: int | tuple[int, int] = 0
    """Difficulty 0 to 9, or (lowest, highest) for a random level in each episode."""
    track_seed: int | None = None
    """Seed of one track for all episodes; None: a random seed for each episode."""
    vehicle: str | os.PathLike[str] | Vehicle | Callable[[np.random.Generator], Vehicle] = "racer5"
    """A shipped name, a file, a vehicle, or a function that draws a vehicle for each episode. All
    drawn vehicles must have the same effects (`suite.train.recipes.race_settings` has those of the
    trainer). The judge flies the vehicle `reference`; training on it makes a comparison unfair."""
    spec: PolicySpec | str | os.PathLike[str] | None = None
    """Rate, camera, encoding and optional inputs of the observation: a spec, or the name or folder
    of a policy with that spec; None: the default."""
    action: str | None = None
    """Kind of action: acceleration, ctbr or motors, with components from -1 to 1. None: the kind of
    the spec. A spec with an action of its own allows no other kind."""
    channel_axis: bool = False
    """Whether images have the shape (1, height, width), in addition to the spec's setting."""
    uint8: bool = False
    """Whether pixels are uint8, 0 to 255, in addition to the spec's setting."""
    rewards: Mapping[str, float] = field(default_factory=dict)
    """Weights of reward terms by name, instead of the defaults in `REWARDS`."""
    rules: Rules = field(default_factory=Rules)
    """Rules for the end of an episode."""

    @classmethod
    def of(cls, **arguments: Any) -> RaceConfig:
        """Return a configuration from arguments, of which `level` and `track_seed` are unchecked.

        Raises:
            TypeError: for an unknown argument, with the most similar one.
            ValueError: for an argument of another type.
        """
        names = [entry.name for entry in fields(cls)]
        for name in arguments.keys() - set(names):
            likely = {"difficulty": "level", "seed": "track_seed"}.get(name, name)
            raise TypeError(str(unknown_name("argument", likely, names)).replace(likely, name, 1))
        config = cls(**arguments)
        check_type("track", config.track, PATH, "a track family or a track file (.toml)")
        said = "a name, a file, a Vehicle or a function that draws one"
        check_type("vehicle", config.vehicle, (*PATH, Vehicle, Callable), said)
        said = "a policy's name or folder, a spec or None"
        check_type("spec", config.spec, (*PATH, PolicySpec, NoneType), said)
        check_type("action", config.action, (str, NoneType), "a kind of action, as a text, or None")
        for name in ("channel_axis", "uint8"):
            check_type(name, getattr(config, name), (bool, np.bool_), "True or False")
        check_type("rewards", config.rewards, (Mapping,), "weights by name of the reward term")
        for name, weight in config.rewards.items():
            check_number(f"rewards[{name!r}]", weight, Range(-1e6, 1e6))
        check_rules(config.rules)
        return config


def levels_of(config: RaceConfig) -> tuple[int, int]:
    """Return the lowest and the highest level.

    Raises:
        ValueError: where `level` is neither a level nor two of them in order.
    """
    given = config.level
    levels = list(given) if isinstance(given, Iterable) else [given, given]
    whole = len(levels) == 2 and all(isinstance(level, Integral) for level in levels)
    if not whole or not LEVELS[0] <= levels[0] <= levels[1] <= LEVELS[-1]:
        raise ValueError(f"level is {given!r}, allowed is 0 to 9, or (lowest, highest)")
    return int(levels[0]), int(levels[1])


def check_track_seed(seed: Any) -> None:
    """Refuse a seed of the track that is neither None nor a seed that the judge can fly."""
    allowed = f"a whole number from 0 to {SEED_MOST}, or None"
    check_type("track_seed", seed, (Integral, NoneType), allowed)
    if seed is not None and not 0 <= seed <= SEED_MOST:
        raise ValueError(f"track_seed is {seed!r}, allowed is {allowed}")


def resolved_vehicle(config: RaceConfig, rng: np.random.Generator) -> Vehicle:
    """Return the configured vehicle, drawn from `rng` if it is random, checked as a file is."""
    vehicle = config.vehicle
    if isinstance(vehicle, str | os.PathLike):
        return load_vehicle(os.fspath(vehicle))
    return checked_vehicle(vehicle if isinstance(vehicle, Vehicle) else vehicle(rng))


def resolved_spec(config: RaceConfig, vehicle: Vehicle) -> PolicySpec:
    """Return the environment's spec, whose actions from -1 to 1 cover the range of `vehicle`.

    Raises:
        ValueError: for an unknown policy or kind of action, or a kind other than the spec's own.
    """
    spec = config.spec or PolicySpec()
    if not isinstance(spec, PolicySpec):
        policy = os.fspath(spec)
        if not locate(policy).is_dir():
            raise unknown_name("policy or folder of a checkpoint", policy, names())
        spec = load_policy_checkpoint(locate(policy)).spec
    depth = replace(
        spec.depth,
        channel_axis=spec.depth.channel_axis or config.channel_axis,
        uint8=spec.depth.uint8 or config.uint8,
    )
    spec = replace(spec, depth=depth)
    kind = config.action or spec.action.kind
    half_thrust = vehicle.full_thrust / 2
    scales = {
        "acceleration": ((ACTION_LIMIT,), (0.0,)),
        "ctbr": ((half_thrust, *vehicle.controller.rate_max), (half_thrust, 0.0, 0.0, 0.0)),
        "motors": ((0.5,), (0.5,)),
    }
    if kind not in scales:
        raise unknown_name("kind of action", kind, scales)
    own = spec.action.kind != "acceleration" or not spec.action.is_plain
    if own and kind != spec.action.kind:
        raise ValueError(
            f"action is {kind!r}, allowed is the spec's {spec.action.kind!r}; leave action out, or "
            "give a spec without an action"
        )
    if not spec.action.is_plain:
        return spec
    scale, offset = scales[kind]
    return replace(spec, action=ActionSpec(kind, scale, offset, spec.action.motors, clip=1.0))


class Races:
    """Episodes of one `RaceConfig` in N slots of a simulator."""

    def __init__(self, config: RaceConfig, slots: int, threads: int = 1) -> None:
        """Check the configuration and make the simulator.

        Raises:
            ValueError: for an unknown track, vehicle, kind of action or reward term, an invalid
                level, spec or track_seed, no slots, or a contact at the start of a track file.
        """
        allowed = "a whole number, 1 or more"
        for name, number in (("num_envs", slots), ("threads", threads)):
            check_type(name, number, (Integral,), allowed)
            if number < 1:
                raise ValueError(f"{name} is {number}, allowed is {allowed}")
        levels_of(config)
        check_track_seed(config.track_seed)
        self.config, self.slots, self._track = config, slots, os.fspath(config.track)
        for name in config.rewards:
            if name not in REWARDS:
                raise unknown_name("reward term", name, REWARDS)
        self._file_track = load_track(self._track) if self._track.endswith(".toml") else None
        if not self._file_track:
            check_family(self._track)
        vehicle = self._vehicle = resolved_vehicle(config, np.random.default_rng(0))
        warn_of(without_signal(vehicle))
        self.spec = resolved_spec(config, vehicle)
        check_spec(self.spec)
        check_rate("the spec", self.spec.rate_hz, vehicle.controller.frequency)
        if self._file_track:
            ignored = {"level": levels_of(config) != (0, 0), "track_seed": config.track_seed}
            said = f"{self._track}: a track from a file has no levels and seeds: "
            warn_of(course_notes(self._track, self._file_track, vehicle))
            warn_of(f"{said}{name} does not change it" for name in ignored if ignored[name])
        else:
            warn_of(family_notes(self._track, levels_of(config)[0], 0, vehicle))
        self.contract: Contract = contract_of(self.spec)
        layout = layout_of([self._file_track] if self._file_track else [])
        self._world = MujocoWorld(
            vehicle, self.spec.camera, layout, config.rules, slots, threads, self.spec.action
        )
        self._limits = limits_of(ActionLimits(), self.spec.action, vehicle)
        self._first_action = first_action(self.spec.action, vehicle)
        self._decision = np.zeros(slots)
        self._action = np.tile(self._first_action, (slots, 1))
        self._output = np.zeros((slots, self.spec.action.size))
        self._tracks: list[Track] = []
        self._bad = np.zeros(slots, bool)
        self.track_seed, self.level = np.zeros(slots, int), np.zeros(slots, int)

    def start(
        self, slots: list[int], rngs: list[np.random.Generator], track_seed: int | None = None
    ) -> None:
        """Begin an episode in each of `slots`.

        Each slot has a random generator for level, track and vehicle. A track file has level 0, as
        in the judge. Without `track_seed`, it is that of the configuration, or a random one.

        Raises:
            ValueError: for a `track_seed` that is not a whole number.
        """
        check_track_seed(track_seed)
        config = self.config
        entries: list[tuple[int, Track, TrialSpec]] = []
        for slot, rng in zip(slots, rngs, strict=True):
            lowest, highest = (0, 0) if self._file_track else levels_of(config)
            level = lowest if lowest == highest else int(rng.integers(lowest, highest + 1))
            seed = config.track_seed if track_seed is None else track_seed
            seed = int(rng.integers(SEEDS)) if seed is None else int(seed)
            track = self._file_track or make_track(self._track, level, seed)
            self._tracks = self._tracks or [track] * self.slots
            self._tracks[slot] = track
            self.track_seed[slot], self.level[slot] = seed, level
            self._decision[slot], self._action[slot] = 0, self._first_action
            self._output[slot], self._bad[slot] = 0.0, False
            name = self._track if self._file_track else track.family
            entries.append((slot, track, TrialSpec(name, level, seed)))
        vehicles = [self._draw_vehicle(rng) for rng in rngs] if callable(config.vehicle) else None
        if entries:
            self._world.load(entries, vehicles)

    def _draw_vehicle(self, rng: np.random.Generator) -> Vehicle:
        """Return a random vehicle for an episode.

        Raises:
            ValueError: where it differs from the first vehicle in more than values of effects.
        """
        vehicle = resolved_vehicle(self.config, rng)
        for part in fields(Vehicle):
            value, first = (getattr(each, part.name) for each in (vehicle, self._vehicle))
            if part.name == "effects":
                value, first = sorted(value), sorted(first)
            if value != first:
                raise ValueError(
                    f"vehicle: the function drew {part.name} {value} after {first}; draw values "
                    "of the same effects around one vehicle (`with_effects`)"
                )
        return vehicle

    def track(self, slot: int) -> Track:
        """Return the track in `slot`."""
        return self._tracks[slot]

    def view(self) -> View:
        """Return the current views, (N, ...)."""
        return self._world.view(np.ones(self.slots, bool))

    def observation(self) -> dict[str, np.ndarray]:
        """Return the observations, (N, ...): `state` and `image`."""
        state, image = observe(self.spec, self.view(), self._action)
        state = np.nan_to_num(np.clip(state, -STATE_LIMIT, STATE_LIMIT))
        return {
            "state": state.astype(np.float32),
            "image": image.astype(np.uint8 if self.spec.depth.uint8 else np.float32),
        }

    def step(self, output: np.ndarray) -> np.ndarray:
        """Fly one action in each slot for a period of the policy's rate; return rewards (N,).

        `output` (N, size) are actions with components from -1 to 1; other shapes are refused.
        """
        output, flying = as_actions(output, self._action.shape), self.ended == FLYING
        guarded = guard_action(self._limits, output, self._action, 0.0, "")
        warn_of(unscaled(guarded.largest))
        self._bad |= flying & guarded.bad
        flying &= ~guarded.bad
        gates_before, to_go_before, time_before_s = self.gates, self.to_go, self.time_s
        clipped = np.clip(np.nan_to_num(output), -1.0, 1.0)
        change = np.sqrt(((clipped - self._output) ** 2).sum(-1)) * flying
        self._action = np.where(flying[:, None], guarded.action_b, self._action)
        self._output = np.where(flying[:, None], clipped, self._output)
        period = 1.0 / (self.spec.rate_hz * self._world.dt)
        steps = np.where(flying, steps_to_next(self._decision, period), 0)
        self._decision += flying
        self._world.advance(self._action, steps, False)
        endings = [self.ended_by(slot) for slot in range(self.slots)]
        failed = np.array([ending not in (None, "finished", "timeout") for ending in endings])
        finished = np.array([ending == "finished" for ending in endings])
        moments = Moments(
            to_go_before, self.to_go, self.gates - gates_before, failed & (flying | self._bad),
            finished & flying, self.time_s - time_before_s, change,
        )  # fmt: skip
        reward = np.zeros(self.slots)
        for name, (default, term) in REWARDS.items():
            if weight := self.config.rewards.get(name, default):
                reward = reward + weight * term(moments)
        return reward

    @property
    def ended(self) -> np.ndarray:
        """(N,) codes of `eval.worlds.trial.Progress.ended`; a bad action has the last code."""
        return np.where(self._bad, len(ENDINGS), self._world.progress.ended)

    @property
    def gates(self) -> np.ndarray:
        """(N,) number of passed gates."""
        return self._world.progress.gates

    @property
    def time_s(self) -> np.ndarray:
        """(N,) time flown [s]."""
        return self._world.progress.step * self._world.dt

    @property
    def to_go(self) -> np.ndarray:
        """(N,) length of the path to the next gate, and from there from gate to gate [m]."""
        slots = zip(self._world.progress.pos_w, self._tracks, self.gates, strict=True)
        return np.array(
            [remaining_path(pos_w, t.scene.gates.center_w, gates) for pos_w, t, gates in slots]
        )

    def ended_by(self, slot: int) -> str | None:
        """Return one of `ENDINGS`, `BAD_ACTION`, or None for a running episode."""
        if self._bad[slot]:
            return BAD_ACTION
        code = int(self.ended[slot])
        return None if code == FLYING else ENDINGS[code - 1]

    def info(self, slot: int) -> dict[str, Any]:
        """Return the info dict of the episode in `slot`, as Gymnasium's `step` returns it."""
        ending = self.ended_by(slot)
        return {
            "track_seed": int(self.track_seed[slot]),
            "level": int(self.level[slot]),
            "gates": int(self.gates[slot]),
            "time_s": float(self.time_s[slot]),
            "ended_by": ending or "",
            "collided_with": self._world.collided_with(slot) if ending == "collision" else "",
            "message": NOT_FINITE if ending == BAD_ACTION else "",
        }
