"""One race in MuJoCo, flown action by action, for the dm_control environment.

A race is one trial (flight) by the rules of the judge, which flies policies and scores them.
"""

from __future__ import annotations

import mujoco
import numpy as np

from eval.judging.guard import check_rate
from eval.quadrotor.autopilot import AutopilotState, autopilot_step, make_autopilot, start_autopilot
from eval.quadrotor.plant import uses_noise
from eval.vehicles.vehicle import Vehicle
from eval.worlds.engine import DepthCamera, OneTrial, motion_of
from eval.worlds.slots import GustDraws
from eval.worlds.trial import ENDINGS, FLYING, Rules, TrialSpec, next_centre, next_gate
from policies.observation import observe, view_of
from policies.spec import PolicySpec, check_spec
from tracks.input.ranges import shown
from tracks.track import Track

ACTION_LIMIT = 20.0
"""Largest absolute value of a component of an action [m/s^2]."""
FAR_BEYOND = 6.0
"""Size of a component of an action from -1 to 1 that noise of a learner hardly reaches."""
STATE_LIMIT = 1e4
"""Limit to which components of the state are clipped; flights are far below it."""
GATE_REWARD = 5.0
"""Reward for a passed gate. The reward for progress along the remaining path is 1 per metre."""
CRASH_REWARD = -1.0
"""Reward for an episode that fails, except by the time limit. With -5, PPO learns to hover."""


class Race(OneTrial):
    """A trial by the judge's rules; the caller provides MuJoCo's `MjData`."""

    def __init__(self, track: Track, vehicle: Vehicle, spec: PolicySpec, rules: Rules) -> None:
        """Compile the model of `vehicle` on `track`.

        Raises:
            ValueError: for a spec that this environment cannot fly.
        """
        self.spec, self.autopilot = spec, make_autopilot(vehicle)
        check_spec(spec)
        check_rate("the spec", spec.rate_hz, vehicle.controller.frequency)
        if spec.action.kind != "acceleration" or not spec.action.is_plain:
            raise ValueError(
                f"spec.action is {spec.action}, allowed is acceleration in SI units; use `RaceEnv` "
                "for other actions"
            )
        if spec.depth.channel_axis or spec.depth.uint8:
            raise ValueError(
                f"spec.depth is {spec.depth}, allowed is channel_axis=False and uint8=False; use "
                "`RaceEnv` for other images"
            )
        super().__init__(track, vehicle, self.autopilot.dt, rules)
        self.steps_a_decision = max(1, round(1 / (spec.rate_hz * self.autopilot.dt)))
        """Number of physics steps between decisions, rounded to a constant."""
        self._gusts: GustDraws | None = None
        if uses_noise(self.autopilot.plant):
            self._gusts = GustDraws(TrialSpec(track.family, track.level, track.seed))
        self._eye = DepthCamera(spec.camera)
        self._loops: AutopilotState
        self.action_b = np.zeros((1, 3))

    @property
    def ended_by(self) -> str | None:
        """One of `eval.worlds.trial.ENDINGS`, or None for a running episode."""
        code = int(self.progress.ended[0])
        return None if code == FLYING else ENDINGS[code - 1]

    def place(self, data: mujoco.MjData) -> None:
        """Put the hovering quadrotor at the start; `data` has just been reset."""
        motion = self.put_at_start(data)
        noise = self._gusts and self._gusts.at(0, 1)
        self._loops = start_autopilot(self.autopilot, motion, noise)
        self.action_b = np.zeros((1, 3))
        self.judge(data, np.array([False]))

    def advance(self, data: mujoco.MjData, action_b: np.ndarray, steps: int) -> float:
        """Fly an action for some physics steps, or until the episode ends; return the reward.

        Args:
            data: state of the simulation after `mj_step1`, as `place` and this function leave it.
            action_b: (3,) wanted acceleration in body axes [m/s^2].
            steps: number of physics steps.

        Raises:
            ValueError: for an action of another shape, not finite, or out of range.
        """
        action = np.asarray(action_b, float)
        if action.shape != (3,) or not (abs(action) <= ACTION_LIMIT).all():
            raise ValueError(
                f"action is {action.tolist()}, allowed are 3 numbers from {-ACTION_LIMIT:g} to "
                f"{ACTION_LIMIT:g} m/s^2; check the policy's output for NaN, or clip it"
            )
        self.action_b = action[None]
        gates_before, path_before = int(self.progress.gates[0]), self._remaining_path()
        for _ in range(steps):
            if self.progress.ended[0] != FLYING:
                break
            motion, step = motion_of(data), self.progress.step
            gate_w = next_centre(self.course, self.progress.gates)
            noise = self._gusts and self._gusts.at(int(step[0]) + 1, 1)
            self._loops, wrench = autopilot_step(
                self.autopilot, self._loops, motion, self.action_b, gate_w, step, noise
            )
            self.move(data, motion, wrench)
        passed = int(self.progress.gates[0]) - gates_before
        reward = path_before - self._remaining_path() + GATE_REWARD * passed
        crashed = self.ended_by not in (None, "finished", "timeout")
        return reward + CRASH_REWARD * crashed

    def _remaining_path(self) -> float:
        progress, centres_w = self.progress, self.course.gates.center_w[0]
        return remaining_path(progress.pos_w[0], centres_w, int(progress.gates[0]))

    def observation(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        """Return the observation: `state` (spec.state_size,) and `image` (H, W), float32."""
        pos_w, rot_w, vel_w, _ = motion_of(data)
        gate = next_gate(self.course, self.progress.gates)
        if self.ended_by == "diverged":
            pos_w, rot_w, vel_w = self.progress.pos_w, np.eye(3)[None], np.zeros((1, 3))
        second_gate = next_gate(self.course, self.progress.gates + 1)
        depth = self._eye.image(self.model, data, pos_w[0], rot_w[0])[None]
        view = view_of(pos_w, rot_w, vel_w, gate, second_gate, depth)
        state, image = (part[0] for part in observe(self.spec, view, self.action_b))
        return {
            "state": np.clip(state, -STATE_LIMIT, STATE_LIMIT).astype(np.float32),
            "image": image.astype(np.float32),
        }


def as_actions(actions: object, shape: tuple[int, ...]) -> np.ndarray:
    """Return the actions of all environments as floats, one row for each.

    Raises:
        ValueError: for something else than numbers of this shape.
    """
    try:
        array = np.asarray(actions, float)
    except (TypeError, ValueError):
        raise ValueError(f"action is {shown(actions)}, allowed are numbers") from None
    if array.shape != shape:
        raise ValueError(
            f"action has shape {array.shape}, expected {shape}: a row for each environment, with "
            f"{shape[1]} numbers; see env.action_space"
        )
    return array


def unscaled(sizes: np.ndarray) -> list[str]:
    """Return a warning if actions, which should be from -1 to 1, are far larger.

    `sizes` (N,) are the largest components of the actions; NaN for those that are not finite.
    """
    largest = np.fmax.reduce(sizes, initial=0.0)
    if largest <= FAR_BEYOND:
        return []
    return [
        f"an action has a component of {largest:.3g}, which is clipped: actions are from -1 to 1; "
        "env.contract has their scale, by which an action in SI units must be divided"
    ]


def remaining_path(pos_w: np.ndarray, centres_w: np.ndarray, gates: int) -> float:
    """Return the length of the path to the next gate, and from there from gate to gate [m].

    `pos_w` (3,) is the drone's position, `centres_w` (G, 3) are the centres of all gates [m]. The
    first `gates` are passed.
    """
    path = np.vstack([pos_w, centres_w[gates:]])
    return float(np.sqrt((np.diff(path, axis=0) ** 2).sum(-1)).sum())
