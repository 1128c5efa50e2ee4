"""The race as environments of Gymnasium: `RaceEnv` and `RaceVectorEnv`.

Importing this file registers them under `ID`, for `gymnasium.make` and `gymnasium.make_vec`.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from numbers import Integral
from types import NoneType
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from eval.envs.race import STATE_LIMIT
from eval.envs.races import RaceConfig, Races
from eval.worlds.trial import FLYING
from policies.contract import Contract
from policies.shipped import names
from policies.spec import PolicySpec
from tracks.common.names import unknown_name
from tracks.input.ranges import PATH, check_type

if TYPE_CHECKING:
    from eval.view.chase import Scenery

ID = "diffracing/Race-v0"
"""Name of the environment in Gymnasium's registry."""
Observation = dict[str, np.ndarray]
"""An observation: arrays `state` and `image`."""
RENDER_SIZE = 640, 360
"""Width and height of a rendered frame [pixels]."""
INSET = 4
"""Ratio of the widths of a rendered frame and the depth image within it."""


def action_space(spec: PolicySpec) -> gymnasium.spaces.Box:
    """Return the space of actions (spec.action.size,), with components from -1 to 1."""
    return gymnasium.spaces.Box(-1.0, 1.0, (spec.action.size,), np.float32)


def observation_space(spec: PolicySpec) -> gymnasium.spaces.Dict:
    """Return the observation space of policies: `state` and `image`."""
    state = gymnasium.spaces.Box(-STATE_LIMIT, STATE_LIMIT, (spec.state_size,), np.float32)
    if spec.depth.uint8:
        image = gymnasium.spaces.Box(0, 255, spec.image_shape, np.uint8)
    else:
        low, high = spec.depth.bounds(spec.camera.range_m)
        # A margin for the rounding of float32.
        image = gymnasium.spaces.Box(low - 1e-4, high + 1e-4, spec.image_shape, np.float32)
    return gymnasium.spaces.Dict({"state": state, "image": image})


def check_render_mode(mode: str | None, allowed: Sequence[str]) -> None:
    """Refuse a render mode that is neither None nor allowed."""
    names = f"{' or '.join(['None', *map(repr, allowed)])}; `RaceEnv` renders"
    check_type("render_mode", mode, (str, NoneType), names)
    if mode not in (None, *allowed):
        raise ValueError(f"render_mode is {mode!r}, allowed is {names}")


def track_seed_of(options: dict[str, Any] | None) -> Any:
    """Return the `track_seed` in the options of `reset`, and refuse others."""
    check_type("options", options, (Mapping, NoneType), "a dict or None")
    for name in options or {}:
        if name != "track_seed":
            raise unknown_name("option of reset", name, ["track_seed"])
    return (options or {}).get("track_seed")


def seeds_of(seed: Any, count: int) -> list[int | None]:
    """Return the seeds of `count` environments: `seed` + i, or entry i of a sequence."""
    if isinstance(seed, Integral):
        return [int(seed) + k for k in range(count)]
    seeds = [None] * count if seed is None else np.ravel(np.asarray(seed, object)).tolist()
    if len(seeds) != count or not all(each is None or isinstance(each, Integral) for each in seeds):
        raise ValueError(
            f"seed is {seed}, allowed is a whole number, or one for each of num_envs = {count} "
            "environments"
        )
    return [None if each is None else int(each) for each in seeds]


def with_full_paths(config: RaceConfig) -> dict[str, Any]:
    """Return the arguments of a `config` whose files were read, with the full paths of the files.

    So a copy of an environment reads the same files in another working folder.
    """
    is_file = {
        "track": os.fspath(config.track).endswith(".toml"),
        "vehicle": isinstance(config.vehicle, PATH) and os.path.isfile(config.vehicle),
        "spec": isinstance(config.spec, PATH) and os.fspath(config.spec) not in names(),
    }
    given = vars(config)
    return given | {name: os.path.abspath(given[name]) for name in is_file if is_file[name]}


class _OfRaces:
    """What the two environments have in common: their contract, and copies before `reset`."""

    _races: Races
    _config: dict[str, Any]
    """Fields of its `RaceConfig`, with full paths."""
    _arguments: dict[str, Any]
    """Arguments of the environment, in addition to the fields of its `RaceConfig`."""

    @property
    def contract(self) -> Contract:
        """The contract for the file of a policy that is trained here."""
        return self._races.contract

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        return self.__reduce__()[0](*self.__reduce__()[1])

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        """Return the arguments for pickling; the copy is a new environment before `reset`."""
        return _make, (type(self), self._config, self._arguments)


class RaceEnv(_OfRaces, gymnasium.Env):
    """Fly through the gates of a track in order, by the rules of the judge.

    The judge is the part of the suite that flies policies and scores them. Each component of an
    action is from -1 to 1. Its meaning is in `contract`, a description of inputs and outputs that
    the file of a policy trained here must contain. An observation has `state`, 12 numbers in SI
    units (more with the spec's extras), and `image`, the encoded inverse depth. The reward is a
    weighted sum of the terms in `eval.envs.races.REWARDS`. The time limit is `truncated`, every
    other ending is `terminated`; `info["ended_by"]` is the reason. Unless the track is fixed,
    `reset` draws a new one; its `options` may contain the `track_seed`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}

    def __init__(self, *, render_mode: str | None = None, **config: Any) -> None:
        """Make the environment.

        Args:
            render_mode: "rgb_array" renders the drone from behind, with the depth image in the
                lower right corner; no display is needed.
            config: the fields of `eval.envs.races.RaceConfig`: track, level, track_seed, vehicle,
                spec, action, channel_axis, uint8, rewards, rules.

        Raises:
            ValueError: for an invalid value.
            TypeError: for an unknown argument.
        """
        check_render_mode(render_mode, self.metadata["render_modes"])
        self._races = Races(RaceConfig.of(**config), 1)
        self._config = with_full_paths(self._races.config)
        self.action_space = action_space(self._races.spec)
        self.observation_space = observation_space(self._races.spec)
        self.render_mode, self._arguments = render_mode, {"render_mode": render_mode}
        self.metadata = {**self.metadata, "render_fps": round(self._races.spec.rate_hz)}
        self._started = False
        self._scenery: Scenery | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Raises:
            ValueError: for an unknown option, or a `track_seed` that is not a whole number.
        """
        super().reset(seed=seed)
        self._races.start([0], [self.np_random], track_seed_of(options))
        self._started, self._scenery = True, None
        return self._observation(), self._races.info(0)

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Fly one action (size,) for a period of the policy's rate.

        Raises:
            RuntimeError: before the first `reset`, and after an episode's end.
        """
        if not self._started:
            raise RuntimeError("call reset() before step()")
        if self._races.ended[0] != FLYING:
            reason = self._races.ended_by(0)
            raise RuntimeError(f"the episode has ended by {reason}: call reset() before step()")
        reward = self._races.step(np.asarray(action).reshape(1, -1))
        info = self._races.info(0)
        truncated = info["ended_by"] == "timeout"
        terminated = bool(info["ended_by"]) and not truncated
        return self._observation(), float(reward[0]), terminated, truncated, info

    def _observation(self) -> Observation:
        return {key: part[0] for key, part in self._races.observation().items()}

    def render(self) -> np.ndarray | None:
        """Return an image (360, 640, 3) uint8 from behind the drone; None without a render mode.

        Raises:
            RuntimeError: before the first `reset`.
        """
        if self.render_mode is None:
            return None
        if not self._started:
            raise RuntimeError("call reset() before render()")
        from eval.view.chase import Drone, chase_image, inset, scenery_of

        view, gates = self._races.view(), int(self._races.gates[0])
        self._scenery = self._scenery or scenery_of(self._races.track(0))
        drone = Drone(view.pos_w[0], view.rot_w[0], gates)
        picture = chase_image(self._scenery, drone, view.vel_w[0], RENDER_SIZE)
        return inset(picture, view.depth_m[0], self._races.spec.camera.range_m, INSET)


class RaceVectorEnv(_OfRaces, VectorEnv):
    """N races at once in one process; the results equal those of N `RaceEnv` to the bit.

    Autoreset is `SAME_STEP`: a step that ends an episode returns the first observation of the next
    episode. The last observation of the ended one is in `info["final_obs"]`, its info in
    `info["final_info"]`.
    """

    def __init__(
        self, num_envs: int = 1, *, threads: int = 1, render_mode: str | None = None, **config: Any
    ) -> None:
        """Make the environments.

        Args:
            num_envs: number of environments.
            threads: threads for physics and images; they do not change the results.
            render_mode: not supported here; `RaceEnv` renders.
            config: as in `RaceEnv`.

        Raises:
            ValueError: for an invalid value.
            TypeError: for an unknown argument.
        """
        check_render_mode(render_mode, ())
        self._races = Races(RaceConfig.of(**config), num_envs, threads)
        self._config = with_full_paths(self._races.config)
        self.num_envs, self.render_mode = num_envs, render_mode
        self._arguments = {"num_envs": num_envs, "threads": threads, "render_mode": render_mode}
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}
        self.single_action_space = action_space(self._races.spec)
        self.single_observation_space = observation_space(self._races.spec)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._rngs: list[np.random.Generator] = []

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | np.ndarray | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observation, dict[str, Any]]:
        """Start all episodes; environment i has the seed `seed` + i, or entry i of a sequence.

        Raises:
            ValueError: for other seeds or as in `RaceEnv.reset`.
        """
        track_seed, seeds = track_seed_of(options), seeds_of(seed, self.num_envs)
        existing = self._rngs or [None] * self.num_envs
        self._rngs = [
            rng if rng is not None and new_seed is None else seeding.np_random(new_seed)[0]
            for rng, new_seed in zip(existing, seeds, strict=True)
        ]
        slots = list(range(self.num_envs))
        self._races.start(slots, self._rngs, track_seed)
        return self._races.observation(), self._infos(slots)

    def step(
        self, actions: np.ndarray
    ) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Fly one action in each environment, (N, size).

        Raises:
            RuntimeError: before the first `reset`.
        """
        if not self._rngs:
            raise RuntimeError("call reset() before step()")
        reward = self._races.step(actions)
        endings = [self._races.ended_by(slot) for slot in range(self.num_envs)]
        truncated = np.array([ending == "timeout" for ending in endings])
        terminated = np.array([ending not in (None, "timeout") for ending in endings])
        ended = truncated | terminated
        ended_slots = np.flatnonzero(ended).tolist()
        observation, infos = self._races.observation(), {}
        if ended_slots:
            final = np.full(self.num_envs, None, object)
            for slot in ended_slots:
                final[slot] = {key: part[slot].copy() for key, part in observation.items()}
            infos = {"final_obs": final, "_final_obs": ended,
                     "final_info": self._infos(ended_slots), "_final_info": ended}  # fmt: skip
            self._races.start(ended_slots, [self._rngs[slot] for slot in ended_slots])
            observation = self._races.observation()
        infos = self._infos(list(range(self.num_envs))) | infos
        return observation, reward, terminated, truncated, infos

    def _infos(self, slots: list[int]) -> dict[str, Any]:
        infos: dict[str, Any] = {}
        for slot in slots:
            infos = self._add_info(infos, self._races.info(slot), slot)
        return infos


def _make(cls: type, config: dict[str, Any], arguments: dict[str, Any]) -> Any:
    return cls(**arguments, **config)


# Gymnasium loads no plugins; by its convention, an import registers environments.
if ID not in gymnasium.registry:
    gymnasium.register(
        id=ID, entry_point=f"{__name__}:RaceEnv", vector_entry_point=f"{__name__}:RaceVectorEnv"
    )
