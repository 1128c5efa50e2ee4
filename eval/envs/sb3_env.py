"""Races by the conventions of Stable-Baselines3 (`pip install 'diffracing-suite[sb3]'`).

The library rejects images with two axes, so here the pixels are one vector, row by row; an image
with `channel_axis=True` is unchanged.
"""

# pyright: reportMissingImports=false, reportMissingModuleSource=false
from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict
from gymnasium.wrappers import TransformObservation
from stable_baselines3.common.vec_env import VecEnv

from eval.envs.gymnasium_env import Observation, RaceEnv, RaceVectorEnv


def race_env(**settings: Any) -> gymnasium.Env:
    """Return `RaceEnv(**settings)` with the spaces of `RaceVecEnv`, for its `check_env`."""
    env = RaceEnv(**settings)
    space = vector_space(env.observation_space)
    return TransformObservation(env, partial(as_space, space), space)


def vector_space(space: gymnasium.Space) -> Dict:
    """Return the space of observations whose image of two axes is one vector."""
    assert isinstance(space, Dict)
    image = space["image"]
    assert isinstance(image, Box)
    if len(image.shape) == 2:
        image = Box(image.low.ravel(), image.high.ravel(), dtype=image.dtype.type)
    return Dict({"state": space["state"], "image": image})


def as_space(space: Dict, seen: Observation, *rows: int) -> Observation:
    """Return observations in the shapes of `space`, with a first axis of `rows` where given."""
    return {key: part.reshape(*rows, *(space[key].shape or ())) for key, part in seen.items()}


class RaceVecEnv(VecEnv):
    """`RaceVectorEnv` by the conventions of Stable-Baselines3: about as fast, in one process."""

    def __init__(self, num_envs: int, **settings: Any) -> None:
        """Make the environments.

        Args:
            num_envs: how many.
            settings: as of `RaceVectorEnv`.
        """
        self.races = RaceVectorEnv(num_envs, **settings)
        self._actions = np.zeros(self.races.action_space.shape or (), np.float32)
        self._space = vector_space(self.races.single_observation_space)
        super().__init__(num_envs, self._space, self.races.single_action_space)

    def reset(self) -> Observation:
        """Start all episodes, with the seed of `seed()` where it was called."""
        seed = None if None in self._seeds else list(self._seeds)
        seen, infos = self.races.reset(seed=seed)
        self._reset_seeds()
        self.reset_infos = [_of(infos, slot) for slot in range(self.num_envs)]
        return as_space(self._space, seen, self.num_envs)

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions (N, size) for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Observation, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Fly the actions; as this library requires, an ended episode restarts at once."""
        seen, reward, terminated, truncated, infos = self.races.step(self._actions)
        over, each = terminated | truncated, []
        for slot in range(self.num_envs):
            info = _of(infos["final_info"] if over[slot] else infos, slot)
            if over[slot]:
                info["terminal_observation"] = as_space(self._space, infos["final_obs"][slot])
                info["TimeLimit.truncated"] = bool(truncated[slot])
            each.append(info)
        seen = as_space(self._space, seen, self.num_envs)
        return seen, reward.astype(np.float32), over, each

    def close(self) -> None:
        """Do nothing: there is no other process."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the environments, once for each."""
        return [getattr(self.races, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse: environments in one simulator have nothing of their own."""
        raise NotImplementedError(f"{attr_name}: make new environments with other settings")

    def env_method(self, method_name: str, *args: Any, **kwargs: Any) -> list[Any]:
        """Refuse: environments in one simulator have nothing of their own."""
        raise NotImplementedError(f"{method_name}: RaceVecEnv.races has the methods of all at once")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Return that none is."""
        return [False for _ in self._get_indices(indices)]


def _of(infos: dict[str, Any], slot: int) -> dict[str, Any]:
    return {key: part[slot] for key, part in infos.items() if not key.startswith(("_", "final_"))}
