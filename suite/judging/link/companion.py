"""The companion computer of a vehicle: runs the policy on received states and images.

It answers the newest state at once with a set point, the wanted body rates and thrust. If a
decision of the policy is due, the policy decides before. The companion has the track, and counts
the passed gates itself. If a check of the watchdog fails, it hands over: it stops sending set
points, and the autopilot takes control. The clock is an argument, for tests.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from eval.judging.guard import ActionLimits, first_action, guard_action, limits_of
from eval.judging.policy_checks.in_flight import Outputs
from eval.quadrotor.attitude import action_to_force, attitude_command, blend_heading, level_heading
from eval.quadrotor.autopilot import ATTITUDE_HZ
from eval.quadrotor.plant import unpack_command
from eval.vehicles.vehicle import Vehicle
from policies.observation import observe, view_of
from policies.policy import Policy
from suite.judging.link.messages import (
    Heartbeat,
    ImageAssembler,
    OperatorText,
    Packet,
    SetPoint,
    State,
    Wire,
)
from suite.judging.link.watchdog import (
    Clock,
    ClockCheck,
    Limits,
    allowed_box,
    jump_fault,
    state_fault,
)
from tracks.geometry.crossing import crossing
from tracks.geometry.rotation import quat_to_rot
from tracks.geometry.scene import Gates
from tracks.track import Track

FINISHED = "all gates passed"
"""Reason of the handover after a complete flight."""
_SLACK_S = 1e-3
"""How much too early a decision may be [s], because time stamps are rounded."""


class Companion:
    """One flight of a policy on a track: receives datagrams, and returns those to send."""

    def __init__(
        self,
        policy: Policy,
        track: Track,
        vehicle: Vehicle,
        wire: Wire,
        clock: Clock,
        limits: Limits | None = None,
    ) -> None:
        """Prepare a flight, which begins with the first state and image.

        The track is in the frame of the vehicle's states. `clock` returns monotonic time [s]. The
        vehicle gives mass, thrust and attitude gains.
        """
        self._policy, self._vehicle, self._wire, self._clock = policy, vehicle, wire, clock
        self._limits = limits or Limits()
        self.action_kind = policy.spec.action.kind
        """The policy's kind of action, `acceleration` or `ctbr`."""
        self._gates = track.scene.gates
        points = np.vstack([self._gates.center_w, np.reshape(track.start_pos_w, (1, 3))])
        self._box = allowed_box(points, self._limits)
        camera = policy.spec.camera
        self._assembler = ImageAssembler(camera.height, camera.width, camera.range_m)
        # The last complete depth image; times of arrival; checks.
        self._depth: np.ndarray | None = None
        self._depth_time_s = self._state_arrival_s = self._new_state_s = clock()
        self._clock_check = ClockCheck(self._limits)
        # The policy's memory, its last action, the heading, and when it decides next.
        self._hidden, self._fresh = policy.start(1), True
        self._action_b = first_action(policy.spec.action, vehicle)[None]
        self._heading_w = np.zeros((1, 3))
        self._start_s, self._next_decision, self._late_in_row = 0.0, 0, 0
        self._last: State | None = None
        self.gate = 0
        """Number of passed gates, which is the index of the next one."""
        self.missed_decisions = 0
        """Number of missed decisions."""
        self.repeated_images = 0
        """Number of decisions on the image of the decision before."""
        self._decided_image_s = -math.inf
        self.outputs = Outputs(1, policy.spec.action)
        """Statistics of the policy's answers, as in the judge."""
        self.over: str | None = None
        """Reason of the handover; None before it."""
        self.rows: list[Row] = []
        """States and set points of the flight so far."""
        self.events: list[str] = []
        """What happened, with times, for the log."""

    @property
    def flying(self) -> bool:
        """Whether the flight has begun and has not ended."""
        return bool(self.rows) and self.over is None

    @property
    def wrong_image_size(self) -> str:
        """A message if depth images have another size than those of the policy, else ""."""
        if self._assembler.other_size is None:
            return ""
        camera, (width, height) = self._policy.spec.camera, self._assembler.other_size
        return (
            f"depth images of {width} x {height} pixels left out: the policy's are "
            f"{camera.width} x {camera.height}"
        )

    def receive(self, datagrams: list[bytes]) -> list[bytes]:
        """Return the datagrams to send after receiving `datagrams` (may be none)."""
        arrival_s = self._clock()
        # Decode the messages, and record how many were left out.
        broken, foreign = self._wire.broken, self._wire.foreign
        messages = self._wire.decode(datagrams)
        new_counts = {"broken": self._wire.broken - broken, "foreign": self._wire.foreign - foreign}
        for kind, count in new_counts.items():
            if count:
                self._record_event(f"{count} {kind} messages left out")
        for message in messages:
            if isinstance(message, Packet):
                self._add_packet(message)
        # Hand over after a silence, else answer the states. If states were waiting after a silence,
        # the vehicle sent them in time, and this computer stood still.
        states = [message for message in messages if isinstance(message, State)]
        silent_s = arrival_s - self._state_arrival_s
        if self.flying and silent_s > self._limits.silence_s:
            if states:
                return self._hand_over(f"this computer stood still for {silent_s:.2f} s")
            return self._hand_over(f"no state for {self._limits.silence_s:g} s")
        if not states or self.over is not None:
            return []
        self._state_arrival_s = arrival_s
        return self._answer(states)

    def heartbeat(self) -> bytes:
        """Return the heartbeat datagram."""
        return self._wire.encode(Heartbeat())

    def end(self, reason: str) -> list[bytes]:
        """Hand over for `reason`; return the datagrams to send, none after an earlier handover."""
        return self._hand_over(reason) if self.over is None else []

    def _record_event(self, text: str) -> None:
        """Add a text with its time to the events, which the flight log has."""
        self.events.append(f"{self._clock():.3f}: {text}")

    def _hand_over(self, reason: str) -> list[bytes]:
        """Stop sending set points, which triggers the vehicle's failsafe, and send the reason."""
        self.over = reason
        self._record_event(f"handed over: {reason}")
        return [self._wire.encode(OperatorText(f"policy hands over: {reason}"))]

    def _add_packet(self, packet: Packet) -> None:
        """Add a packet of an image; record when an image with another wrong size is announced."""
        size_before = self._assembler.other_size
        image = self._assembler.add(packet)
        if self._assembler.other_size != size_before:
            self._record_event(self.wrong_image_size)
        if image is not None:
            self._depth, self._depth_time_s = image, self._clock()

    def _answer(self, states: list[State]) -> list[bytes]:
        """Check all received states, and answer only the newest one."""
        # Checks of states, clock and image.
        for state in states:
            fault = state_fault(state, self._box, self._limits)
            if fault:
                return self._hand_over(fault)
        states = sorted(states, key=lambda state: state.time_s)
        fault = self._clock_check.add(states[-1].time_s, self._state_arrival_s)
        if fault:
            return self._hand_over(fault)
        is_image_old = self._state_arrival_s - self._depth_time_s > self._limits.image_age_s
        if self.rows and is_image_old:
            return self._hand_over(f"no image for {self._limits.image_age_s:g} s")
        if self._depth is None or is_image_old:
            return []
        # The flight begins with the first state for which there is an image.
        if self._last is None:
            states = states[-1:]
            self._start_s = states[0].time_s
            self._heading_w = level_heading(quat_to_rot(states[0].quat_wxyz)[None])
            self._record_event("begun")
        # Count gates along all new states; states that arrived out of order are left out.
        new = [s for s in states if self._last is None or s.time_s > self._last.time_s]
        for state in new:
            fault = self._last and jump_fault(self._last, state, self._limits)
            if fault:
                return self._hand_over(fault)
            self._count_gates(state)
            if self.gate == len(self._gates.center_w):
                return self._hand_over(FINISHED)
        if new:
            self._new_state_s = self._state_arrival_s
            return self._fly(new[-1])
        if self._state_arrival_s - self._new_state_s > self._limits.silence_s:
            return self._hand_over(f"no newer state for {self._limits.silence_s:g} s")
        return []

    def _count_gates(self, state: State) -> None:
        """Count the next gate if the path from the last state to `state` crosses its opening."""
        if self._last is not None:
            center_w, rot_w, opening_g = (x[self.gate] for x in self._gates[:3])
            passed, _ = crossing(center_w, rot_w, opening_g, self._last.pos_w, state.pos_w)
            self.gate += bool(passed)
        self._last = state

    def _fly(self, state: State) -> list[bytes]:
        """Return the set point for a state, after a decision of the policy if one is due."""
        # Time since the last set point. At the first state it is one period of the autopilot, as in
        # simulated trials.
        since_s = state.time_s - self.rows[-1].state.time_s if self.rows else 1.0 / ATTITUDE_HZ
        decided = self._is_due(state)
        rot_w = quat_to_rot(state.quat_wxyz)[None]
        image_age_s = self._clock() - self._depth_time_s
        fault = self._decide(state, rot_w) if decided else None
        if fault:
            return self._hand_over(fault)
        # From the action to thrust and body rates; the heading follows the next gate.
        to_gate_w = self._gates.center_w[None, self.gate] - state.pos_w
        self._heading_w = blend_heading(self._heading_w, to_gate_w, since_s)
        command = unpack_command(self._action_b)
        if self.action_kind == "acceleration":
            force_w = action_to_force(self._action_b, rot_w)
            command = attitude_command(self._vehicle.controller, force_w, rot_w, self._heading_w)
        thrust, rate_b = float(command.thrust[0]), command.rate_b[0]
        # A real autopilot's thrust is a share of its own maximum; docs/fly.md describes its
        # measurement.
        share = min(1.0, thrust / self._vehicle.full_thrust)
        datagram = self._wire.encode(SetPoint(rate_b, share))
        now_s = self._clock()
        self.rows.append(
            Row(
                state, thrust, rate_b, self._action_b[0], decided, self.gate,
                self._clock_check.vehicle_time(now_s), now_s - self._state_arrival_s,
                now_s - state.time_s, image_age_s,
            )
        )  # fmt: skip
        return [datagram]

    def _is_due(self, state: State) -> bool:
        """Return whether a decision is due at a state; missed decisions are not made up for.

        The memory of the policy assumes a fixed time between decisions. Several decisions at once
        would count as more time than has passed.
        """
        since_s = state.time_s - self._start_s + _SLACK_S
        decision = int(since_s * self._policy.spec.rate_hz)
        if decision < self._next_decision:
            return False
        self.missed_decisions += decision - self._next_decision
        self._next_decision = decision + 1
        return True

    def _decide(self, state: State, rot_w: np.ndarray) -> str | None:
        """Update the action by a decision of the policy; return a reason to hand over, or None."""
        # Observe.
        depth = self._depth
        assert depth is not None
        self.repeated_images += self._depth_time_s == self._decided_image_s
        self._decided_image_s = self._depth_time_s
        count = len(self._gates.center_w)
        view = view_of(
            state.pos_w[None],
            rot_w,
            state.vel_w[None],
            _gate(self._gates, self.gate),
            _gate(self._gates, min(self.gate + 1, count - 1)),
            depth[None],
        )
        state_b, image = (
            np.asarray(x, np.float32) for x in observe(self._policy.spec, view, self._action_b)
        )
        # Decide, and limit the action as the judge does.
        fresh = np.array([self._fresh])
        limits = ActionLimits(deadline_s=self._limits.deadline_s)
        limits = limits_of(limits, self._policy.spec.action, self._vehicle)
        try:
            answer, self._hidden = self._policy.act(self._hidden, state_b, image, fresh)
            duration_s = self._clock() - self._state_arrival_s
            guarded = guard_action(limits, answer, self._action_b, duration_s, self._policy.name)
        except Exception as error:  # after any error the autopilot must take control
            return f"the policy failed: {type(error).__name__}: {error}"
        self._action_b, self._fresh = guarded.action_b, False
        self.outputs.add(guarded, state_b)
        self._late_in_row = self._late_in_row + 1 if guarded.late[0] else 0
        if guarded.bad[0]:
            return "the policy's answer is not finite"
        if self._late_in_row >= self._limits.late_most:
            return f"{self._late_in_row} late answers in a row"
        return None


def _gate(gates: Gates, number: int) -> Gates:
    """Return one gate as a batch of one."""
    return Gates(*(x[None, number] for x in gates))


class Row(NamedTuple):
    """State, decision and set point of the companion at one time."""

    state: State
    """The vehicle's state that was answered."""
    thrust: float
    """Wanted collective thrust per mass [m/s^2]."""
    rate_b: np.ndarray
    """(3,) wanted body rates [rad/s]."""
    action_b: np.ndarray
    """(size,) the policy's current action, in SI units."""
    decided: bool
    """Whether the policy decided on this state."""
    gate: int
    """Index of the next gate."""
    sent_s: float
    """Time at which the set point was sent, by the vehicle's clock [s]."""
    answered_s: float
    """Time from the state's arrival to its set point [s]."""
    state_age_s: float
    """Time from the state's time stamp to its set point [s]. It is valid only if both ends of the
    link have the same clock."""
    image_age_s: float
    """Time from the arrival of the image to the decision [s]."""
