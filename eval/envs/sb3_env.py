"""The race as environments of Stable-Baselines3 (`pip install 'diffracing-suite[sb3]'`).

The library refuses images with two axes. So the pixels of an image are one vector here, row by row;
an image with `channel_axis=True` is unchanged.
"""

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
    """Return a space of observations with an image of two axes converted to a vector."""
    assert isinstance(space, Dict)
    image = space["image"]
    assert isinstance(image, Box)
    if len(image.shape) == 2:
        image = Box(image.low.ravel(), image.high.ravel(), dtype=image.dtype.type)
    return Dict({"state": space["state"], "image": image})


def as_space(space: Dict, observation: Observation, *rows: int) -> Observation:
    """Return observations reshaped to `space`; `rows` is the size of a first axis, if any."""
    return {
        key: part.reshape(*rows, *(space[key].shape or ())) for key, part in observation.items()
    }


class RaceVecEnv(VecEnv):
    """`RaceVectorEnv` by the conventions of Stable-Baselines3: N races in one process."""

    def __init__(self, num_envs: int, **settings: Any) -> None:
        """Make `num_envs` environments; `settings` are arguments of `RaceVectorEnv`."""
        self.races = RaceVectorEnv(num_envs, **settings)
        self._actions = np.zeros(self.races.action_space.shape or (), np.float32)
        self._space = vector_space(self.races.single_observation_space)
        super().__init__(num_envs, self._space, self.races.single_action_space)

    def reset(self) -> Observation:
        """Start all episodes, with the seeds of `seed()` and options of `set_options()`, if any.

        Raises:
            ValueError: for options that differ between environments.
        """
        seed, options = None if None in self._seeds else list(self._seeds), self._options[0]
        if any(other != options for other in self._options):
            raise ValueError(f"options are {self._options}, allowed is one dict for all")
        observation, infos = self.races.reset(seed=seed, options=options)
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [_info_of(infos, slot) for slot in range(self.num_envs)]
        return as_space(self._space, observation, self.num_envs)

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions (N, size) for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Observation, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Fly the actions; an ended episode restarts at once, as the library requires."""
        observation, reward, terminated, truncated, infos = self.races.step(self._actions)
        ended, slot_infos = terminated | truncated, []
        for slot in range(self.num_envs):
            info = _info_of(infos["final_info"] if ended[slot] else infos, slot)
            if ended[slot]:
                info["terminal_observation"] = as_space(self._space, infos["final_obs"][slot])
                info["TimeLimit.truncated"] = bool(truncated[slot])
                self.reset_infos[slot] = _info_of(infos, slot)
            slot_infos.append(info)
        observation = as_space(self._space, observation, self.num_envs)
        return observation, reward.astype(np.float32), ended, slot_infos

    def close(self) -> None:
        """Do nothing, since there is no other process."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the environments, once for each."""
        return [getattr(self.races, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse, since the environments are one object."""
        raise NotImplementedError(f"{attr_name}: make new environments with other settings")

    def env_method(self, method_name: str, *args: Any, **kwargs: Any) -> list[Any]:
        """Refuse, since the environments are one object."""
        raise NotImplementedError(f"{method_name}: RaceVecEnv.races has the methods of all at once")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Return False for each environment."""
        return [False for _ in self._get_indices(indices)]


def _info_of(infos: dict[str, Any], slot: int) -> dict[str, Any]:
    """Return the info of one environment from Gymnasium's dict of arrays."""
    return {key: part[slot] for key, part in infos.items() if not key.startswith(("_", "final_"))}
