"""The race as a `gymnasium.Env`."""

from __future__ import annotations

from typing import Any

import gymnasium
import mujoco
import numpy as np

from eval.envs.race import ACTION_LIMIT, STATE_LIMIT, Race
from eval.quadrotor.vehicle_file import load_vehicle
from eval.vehicles.vehicle import Vehicle
from eval.worlds.trial import Rules
from policies.spec import ACTION_SIZE, PolicySpec
from tracks.families import make_track

SEEDS = 2**31
"""Tracks are drawn with seeds below this."""


class RaceEnv(gymnasium.Env):
    """Fly the gates of a track in order with the judge's quadrotor and rules.

    An action is the wanted net acceleration in body axes over `eval.envs.race.ACTION_LIMIT`, each
    component from -1 to 1, as learning libraries want it; an observation is what policies see:
    `state`, the paper's 12 numbers (more where `spec` has them), and `image`, the encoded
    inverse depth. The reward is the progress towards the next gate [m], 1 a gate, and -5 for a
    crash. `terminated` is every end by the judge's rules but the time limit, which is `truncated`.
    A `reset` without a fixed track draws a new one.
    """

    metadata = {"render_modes": []}

    def __init__(
        self,
        family: str = "zigzag",
        level: int = 0,
        track_seed: int | None = None,
        vehicle: Vehicle | None = None,
        spec: PolicySpec | None = None,
        rules: Rules | None = None,
    ) -> None:
        """Make the environment.

        Args:
            family: of the tracks.
            level: 0 to 9.
            track_seed: of one track flown every time; None draws one at each reset.
            vehicle: what flies; `eval/vehicles/reference.toml` where it is left out.
            spec: rate, camera and encoding of the observation.
            rules: when an episode ends.
        """
        self._family, self._level, self._track_seed = family, level, track_seed
        self._vehicle = vehicle or load_vehicle("reference")
        self._spec, self._rules = spec or PolicySpec(), rules or Rules()
        camera, depth = self._spec.camera, self._spec.depth
        low = depth.scale / max(camera.range_m, depth.near) - depth.offset
        high = depth.scale / depth.near - depth.offset
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (ACTION_SIZE,), np.float32)
        self.observation_space = gymnasium.spaces.Dict(
            {
                "state": gymnasium.spaces.Box(
                    -STATE_LIMIT, STATE_LIMIT, (self._spec.state_size,), np.float32
                ),
                "image": gymnasium.spaces.Box(
                    # A margin for the rounding of float32.
                    low - 1e-4, high + 1e-4, (camera.height, camera.width), np.float32,
                ),
            }
        )  # fmt: skip
        self._race: Race | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start an episode; `options` may hold the `track_seed` to fly."""
        super().reset(seed=seed)
        chosen = (options or {}).get("track_seed", self._track_seed)
        track_seed = int(self.np_random.integers(SEEDS)) if chosen is None else int(chosen)
        track = make_track(self._family, self._level, track_seed)
        self._race = Race(track, self._vehicle, self._spec, self._rules)
        self._data = mujoco.MjData(self._race.model)
        self._race.place(self._data)
        return self._race.observation(self._data), {"track_seed": track_seed, "gates": 0}

    def step(
        self, action: np.ndarray
    ) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Fly one action for a period of the policy's rate.

        Raises:
            RuntimeError: before the first `reset`.
        """
        race = self._race
        if race is None:
            raise RuntimeError("call reset() before step()")
        # Beyond the space there is nothing; what is no number stays one, for the guard to refuse.
        action_b = ACTION_LIMIT * np.clip(np.asarray(action, float), -1.0, 1.0)
        reward = race.advance(self._data, action_b, race.steps_to_decision())
        info = {"gates": int(race.progress.gates[0]), "ended_by": race.ended_by}
        truncated = race.ended_by == "timeout"
        terminated = race.ended_by is not None and not truncated
        return race.observation(self._data), reward, terminated, truncated, info
