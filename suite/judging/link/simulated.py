"""A simulated vehicle at one end of a link, which acts like a flight controller with a camera.

It sends its state and depth images over MAVLink, and flies the received set points (body rates and
thrust). Before the first set point it stays at the trial's start. If set points stop, it brakes and
hovers. The physics are those of the judge.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from eval.quadrotor.attitude import action_to_force, attitude_command, level_heading
from eval.quadrotor.autopilot import make_autopilot, start_autopilot
from eval.quadrotor.plant import Command, Motion, uses_noise
from eval.quadrotor.stepper import Inputs, plant_step
from eval.vehicles.vehicle import Vehicle
from eval.worlds.engine import DepthCamera, OneTrial, contact_name, motion_of
from eval.worlds.slots import GustDraws
from eval.worlds.trial import FLYING, Rules, TrialResult, TrialSpec, result_columns
from suite.judging.link.messages import SetPoint, State, Wire, image_packets
from tracks.geometry.camera import Camera
from tracks.geometry.rotation import to_local
from tracks.track import Track

LOST_S = 0.2
"""Time without a set point after which the vehicle brakes [s]."""
BRAKE = 2.0
"""Deceleration while braking, divided by the speed [1/s]."""
BRAKE_MOST = 6.0
"""Largest deceleration while braking, on each axis [m/s^2]."""


class FlightRequest(NamedTuple):
    """A flight of a simulated vehicle."""

    track: Track
    trial: TrialSpec
    """The trial, whose seed determines the gusts."""
    vehicle: Vehicle
    rules: Rules
    """When the trial ends."""
    camera: Camera
    image_hz: float
    """Rate of the depth images [Hz]."""
    policy: str
    """Name of the policy, for the result."""
    address: str = ""
    """UDP address of the other end."""


class SimulatedVehicle:
    """The vehicle of one trial; `step` makes one physics step."""

    def __init__(self, request: FlightRequest, wire: Wire) -> None:
        """Place the vehicle at the start of its track."""
        self._request, self._wire, trial = request, wire, request.trial
        self._autopilot = make_autopilot(request.vehicle)
        self.dt = self._autopilot.dt
        self._judged = OneTrial(request.track, request.vehicle, self.dt, request.rules)
        self._data = mujoco.MjData(self._judged.model)
        motion = self._judged.put_at_start(self._data)
        self._gusts = GustDraws(trial) if uses_noise(self._autopilot.plant) else None
        first = self._gusts and self._gusts.at(0, 1)
        self._plant = start_autopilot(self._autopilot, motion, first).plant
        self._eye = DepthCamera(request.camera)
        self._steps_an_image = 1 / (request.image_hz * self.dt)
        self._command: Command | None = None
        self._command_step = self._ticks = 0
        self.images = 0
        """Number of sent images."""

    @property
    def over(self) -> bool:
        """Whether the trial has ended."""
        return int(self._judged.progress.ended[0]) != FLYING

    @property
    def begun(self) -> bool:
        """Whether a set point has been received."""
        return self._command is not None

    @property
    def time_s(self) -> float:
        """Time since the vehicle was started [s]."""
        return self._ticks * self.dt

    def step(self, datagrams: list[bytes], clock_s: float | None = None) -> list[bytes]:
        """Make one physics step; return the datagrams of the state and the image at its beginning.

        `datagrams` were received since the last step. `clock_s` is the time for the time stamps
        [s]; None: the time since the start.
        """
        # Take the newest valid set point, within the vehicle's limits.
        for message in self._wire.decode(datagrams):
            if (
                isinstance(message, SetPoint)
                and np.isfinite([*message.rate_b, message.thrust]).all()
            ):
                thrust = np.clip(message.thrust, 0.0, 1.0) * self._request.vehicle.full_thrust
                limit = np.array(self._request.vehicle.controller.rate_max)
                rate_b = np.clip(message.rate_b, -limit, limit)
                self._command = Command(np.array([thrust]), rate_b[None])
                self._command_step = int(self._judged.progress.step[0])
        motion = motion_of(self._data)
        sent = self._measurements(motion, self.time_s if clock_s is None else clock_s)
        self._ticks += 1
        if self._command is not None and not self.over:
            self._fly(motion, self._command)
        return sent

    def _measurements(self, motion: Motion, clock_s: float) -> list[bytes]:
        """Return the datagrams of the image and the state that are due at this step."""
        sent = []
        if self._ticks >= round(self.images * self._steps_an_image):
            pose = motion.pos_w[0], motion.rot_w[0]
            depth = self._eye.image(self._judged.model, self._data, *pose)
            packets = image_packets(depth, self._eye.camera.range_m)
            sent += [self._wire.encode(packet) for packet in packets]
            self.images += 1
        if self._ticks % self._autopilot.attitude_every == 0:
            quat = self._data.qpos[3:].copy()
            state = State(clock_s, motion.pos_w[0], quat, motion.vel_w[0], motion.rate_b[0])
            sent.append(self._wire.encode(state))
        return sent

    def _fly(self, motion: Motion, command: Command) -> None:
        """Make one physics step with the command; brake if the command is too old."""
        step = int(self._judged.progress.step[0])
        if (step - self._command_step) * self.dt > LOST_S:
            command = self._brake_command(motion)
        noise = self._gusts and self._gusts.at(step + 1, 1)
        plant, wrench = plant_step(
            self._autopilot.plant,
            self._plant,
            motion,
            Inputs(command, noise=noise),
            np.array([step * self.dt]),
        )
        self._plant = plant
        self._judged.move(self._data, motion, wrench)

    def _brake_command(self, motion: Motion) -> Command:
        """Return the command that decelerates to hover, with the present heading."""
        acc_w = (-BRAKE * motion.vel_w).clip(-BRAKE_MOST, BRAKE_MOST)
        force_w = action_to_force(to_local(motion.rot_w, acc_w), motion.rot_w)
        heading_w = level_heading(motion.rot_w)
        controller = self._request.vehicle.controller
        return attitude_command(controller, force_w, motion.rot_w, heading_w)

    def result(self) -> TrialResult:
        """Return the trial's result so far; an unfinished one counts as a timeout.

        The companion counts the actions, here their numbers are 0.
        """
        columns = result_columns(self._judged.progress, 0, self.dt)
        is_collision = columns["ended_by"] == "collision"
        return TrialResult(
            *self._request.trial,
            **columns,
            policy=self._request.policy,
            vehicle=self._request.vehicle.name,
            world="link",
            collided_with=contact_name(self._judged.model, self._data) if is_collision else None,
            bad_actions=0,
            limited_actions=0,
            late_actions=0,
        )
