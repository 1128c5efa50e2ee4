"""The race as an environment of dm_control (`dm_control.rl.control.Environment`)."""

from __future__ import annotations

from types import NoneType
from typing import Any

import numpy as np
from dm_control import mujoco as dm_mujoco
from dm_control.mujoco import wrapper
from dm_control.rl import control
from dm_env import specs

from eval.effects import without_signal
from eval.envs.race import ACTION_LIMIT, Race
from eval.quadrotor.vehicle_file import load_vehicle
from eval.vehicles.vehicle import Vehicle
from eval.worlds.engine import course_notes, warn_of
from eval.worlds.trial import Rules, check_rules
from policies.spec import ACTION_SIZE, PolicySpec
from tracks.families import make_track
from tracks.input.ranges import check_type
from tracks.track import Track


class RacePhysics(dm_mujoco.Physics):
    """MuJoCo's physics, with the force and torque of the quadrotor's rotors and effects added."""

    race: Race
    """The episode: course, rules and control loops."""
    reward: float
    """Reward of the last step."""

    def step(self, nstep: int = 1) -> None:
        """Fly the task's action for `nstep` physics steps."""
        self.reward = self.race.advance(self.data.ptr, self.action_b, nstep)

    action_b: np.ndarray = np.zeros(ACTION_SIZE)
    """(3,) current action, a wanted acceleration in body axes [m/s^2]."""


class RaceTask(control.Task):
    """Fly through the gates in order; rewards and endings are those of `eval.envs.race`."""

    def initialize_episode(self, physics: RacePhysics) -> None:
        """Put the quadrotor at the start."""
        physics.race.place(physics.data.ptr)

    def before_step(self, action: np.ndarray, physics: RacePhysics) -> None:
        """Set the wanted net acceleration in body axes (3,) [m/s^2]."""
        physics.action_b = np.asarray(action, float)

    def after_step(self, physics: RacePhysics) -> None:
        """Do nothing: `Race.advance` applies the rules after every physics step."""

    def action_spec(self, physics: RacePhysics) -> specs.BoundedArray:
        """Return the bounds of an action [m/s^2]."""
        bound = np.full(ACTION_SIZE, ACTION_LIMIT)
        return specs.BoundedArray((ACTION_SIZE,), np.float64, -bound, bound, "acceleration_b")

    def observation_spec(self, physics: RacePhysics) -> dict[str, specs.Array]:
        """Return the shapes of the observation."""
        spec = physics.race.spec
        return {
            "state": specs.Array((spec.state_size,), np.float32, "state"),
            "image": specs.Array(spec.image_shape, np.float32, "image"),
        }

    def get_observation(self, physics: RacePhysics) -> dict[str, np.ndarray]:
        """Return the observation: `state` (spec.state_size,) and `image` (H, W)."""
        return physics.race.observation(physics.data.ptr)

    def get_reward(self, physics: RacePhysics) -> float:
        """Return the reward of the last step."""
        return physics.reward

    def get_termination(self, physics: RacePhysics) -> float | None:
        """Return the discount of an ended episode (1 for a timeout), None for a running one."""
        ended = physics.race.ended_by
        if ended is None:
            return None
        return 1.0 if ended == "timeout" else 0.0


def load(
    family: str = "zigzag",
    level: int = 0,
    seed: int = 0,
    track: Track | None = None,
    vehicle: Vehicle | None = None,
    spec: PolicySpec | None = None,
    rules: Rules | None = None,
    **environment: Any,
) -> control.Environment:
    """Return the environment of one track.

    Args:
        family: name of the track family.
        level: difficulty level, 0 to 9.
        seed: seed of the track.
        track: a track that is flown instead. The random numbers of gusts depend on its name; in the
            judge they depend on the name of its file.
        vehicle: the vehicle; None: `eval/vehicles/reference.toml`.
        spec: rate, camera and encoding of the observation; the period is rounded to whole physics
            steps. Actions are accelerations in SI units, images have two axes of float32.
        rules: rules for the end of an episode; None: the judge's.
        environment: further arguments of `dm_control.rl.control.Environment`.

    Raises:
        ValueError: for an unknown track, a contact at the start of `track`, or a spec that this
            environment cannot fly.
    """
    check_type("track", track, (Track, NoneType), "a Track or None")
    check_type("vehicle", vehicle, (Vehicle, NoneType), "a Vehicle or None")
    check_type("spec", spec, (PolicySpec, NoneType), "a PolicySpec or None")
    rules = Rules() if rules is None else rules
    check_rules(rules)
    vehicle = vehicle or load_vehicle("reference")
    warn_of(without_signal(vehicle))
    if track is not None:
        warn_of(course_notes(track.family, track, vehicle))
    track = track or make_track(family, level, seed)
    race = Race(track, vehicle, spec or PolicySpec(), rules)
    physics = RacePhysics.from_model(wrapper.MjModel(race.model))
    physics.race = race
    return control.Environment(
        physics, RaceTask(), n_sub_steps=race.steps_a_decision, **environment
    )
