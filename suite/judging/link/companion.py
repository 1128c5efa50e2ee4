"""The companion computer: states and images in, body rates and thrust out, and its watchdog.

It has the course, counts gates itself, and reacts to messages: it answers the newest state with a
set point at once, after a decision of the policy if one is due. The clock is an argument, for
tests.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from eval.judging.guard import ActionLimits, first_action, guard_action, limits_of
from eval.quadrotor.attitude import (
    action_to_force,
    attitude_command,
    blend_heading,
    level_heading,
)
from eval.quadrotor.autopilot import ATTITUDE_HZ
from eval.quadrotor.plant import unpack_command
from eval.vehicles.vehicle import Vehicle
from policies.observation import observe, view_of
from policies.policy import Policy
from policies.spec import PolicyError
from suite.judging.link.messages import Alive, Note, Packet, Picture, SetPoint, State, Wire
from suite.judging.link.watchdog import (
    Clock,
    ClockCheck,
    Limits,
    box_of,
    trouble_between,
    trouble_with_state,
)
from tracks.geometry.crossing import crossing
from tracks.geometry.rotation import quat_to_rot
from tracks.geometry.scene import Gates
from tracks.track import Track

FINISHED = "all gates passed"
"""The reason of the hand-over after a complete flight."""
_SLACK_S = 1e-3
"""A decision is due this much earlier, because time stamps are rounded [s]."""


class Companion:
    """One flight of a policy on a course."""

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

        Args:
            policy: the policy.
            track: the course, in the frame of the vehicle's states.
            vehicle: gives mass, thrust and attitude gains.
            wire: this end of the link.
            clock: monotonic time [s].
            limits: of the watchdog.
        """
        self._policy, self._vehicle, self._wire, self._clock = policy, vehicle, wire, clock
        self._limits, self._kind = limits or Limits(), policy.spec.action.kind
        if self._kind == "motors":
            raise PolicyError(
                f"{policy.name}: commands motors; a link takes body rates and thrust: fly a policy "
                "of accelerations or ctbr"
            )
        self._gates = track.scene.gates
        points = np.vstack([self._gates.center_w, np.reshape(track.start_pos_w, (1, 3))])
        self._box = box_of(points, self._limits)
        camera = policy.spec.camera
        self._picture = Picture(camera.height, camera.width, camera.range_m)
        self._depth: np.ndarray | None = None
        self._depth_at = self._heard_at = clock()
        self._clocks = ClockCheck(self._limits)
        self._hidden, self._fresh = policy.start(1), True
        self._action_b = first_action(policy.spec.action, vehicle)[None]
        self._heading_w = np.zeros((1, 3))
        self._begun_s, self._next, self._late = 0.0, 0, 0
        self._last: State | None = None
        self.gate = 0
        self.late_answers = self.bad_actions = self.missed_decisions = 0
        self.over: str | None = None
        self.rows: list[Row] = []
        self.events: list[str] = []

    @property
    def flying(self) -> bool:
        """Whether the flight has begun and has not ended."""
        return bool(self.rows) and self.over is None

    @property
    def wrong_image_size(self) -> str:
        """A message about depth images of another size than the policy's; empty without any."""
        if self._picture.other_size is None:
            return ""
        camera, (width, height) = self._policy.spec.camera, self._picture.other_size
        return (
            f"depth images of {width} x {height} pixels left out: the policy's are "
            f"{camera.width} x {camera.height}"
        )

    def receive(self, datagrams: list[bytes]) -> list[bytes]:
        """Return the datagrams to send after receiving `datagrams` (may be none)."""
        heard_s = self._clock()
        before = self._wire.broken, self._wire.foreign
        messages = self._wire.decoded(datagrams)
        for what, count, was in zip(
            ("broken", "foreign"), (self._wire.broken, self._wire.foreign), before, strict=True
        ):
            if count > was:
                self._event(f"{count - was} {what} messages left out")
        for message in messages:
            if isinstance(message, Packet):
                self._see(message)
        states = [message for message in messages if isinstance(message, State)]
        silent_s = heard_s - self._heard_at
        if self.flying and silent_s > self._limits.silence_s:
            if states:
                return self._hand_over(f"this computer stood still for {silent_s:.2f} s")
            return self._hand_over(f"no state for {self._limits.silence_s:g} s")
        if not states or self.over is not None:
            return []
        self._heard_at = heard_s
        return self._answer(states)

    def alive(self) -> bytes:
        """Return the heartbeat datagram."""
        return self._wire.encoded(Alive())

    def end(self, reason: str) -> list[bytes]:
        """Return the datagrams of a hand-over for `reason`; none after an earlier one."""
        return self._hand_over(reason) if self.over is None else []

    def _event(self, text: str) -> None:
        self.events.append(f"{self._clock():.3f}: {text}")

    def _hand_over(self, reason: str) -> list[bytes]:
        """Stop sending set points, which triggers the vehicle's failsafe, and send the reason."""
        self.over = reason
        self._event(f"handed over: {reason}")
        return [self._wire.encoded(Note(f"policy hands over: {reason}"))]

    def _see(self, packet: Packet) -> None:
        known, found = self._picture.other_size, self._picture.add(packet)
        if self._picture.other_size != known:
            self._event(self.wrong_image_size)
        if found is not None:
            self._depth, self._depth_at = found, self._clock()

    def _answer(self, states: list[State]) -> list[bytes]:
        """Check all received states, and answer only the newest one."""
        for state in states:
            trouble = trouble_with_state(state, self._box, self._limits)
            if trouble:
                return self._hand_over(trouble)
        states = sorted(states, key=lambda state: state.time_s)
        trouble = self._clocks.add(states[-1].time_s, self._heard_at)
        if trouble:
            return self._hand_over(trouble)
        aged = self._heard_at - self._depth_at > self._limits.image_age_s
        if self.rows and aged:
            return self._hand_over(f"no image for {self._limits.image_age_s:g} s")
        if self._depth is None or aged:
            return []
        if self._last is None:
            states = states[-1:]
            self._begun_s = states[0].time_s
            self._heading_w = level_heading(quat_to_rot(states[0].quat_wxyz)[None])
            self._event("begun")
        # Others arrived out of order.
        news = [s for s in states if self._last is None or s.time_s > self._last.time_s]
        for state in news:
            trouble = self._last and trouble_between(self._last, state, self._limits)
            if trouble:
                return self._hand_over(trouble)
            self._count_gates(state)
            if self.gate == len(self._gates.center_w):
                return self._hand_over(FINISHED)
        return self._fly(news[-1]) if news else []

    def _count_gates(self, state: State) -> None:
        if self._last is not None:
            center_w, rot_w, opening_g = (x[self.gate] for x in self._gates[:3])
            passed, _ = crossing(center_w, rot_w, opening_g, self._last.pos_w, state.pos_w)
            self.gate += bool(passed)
        self._last = state

    def _fly(self, state: State) -> list[bytes]:
        # One period of the autopilot at the first state, as in the judge.
        since_s = state.time_s - self.rows[-1].state.time_s if self.rows else 1.0 / ATTITUDE_HZ
        decided = self._is_due(state)
        rot_w = quat_to_rot(state.quat_wxyz)[None]
        image_age_s = self._clock() - self._depth_at
        trouble = self._decide(state, rot_w) if decided else None
        if trouble:
            return self._hand_over(trouble)
        to_gate_w = self._gates.center_w[None, self.gate] - state.pos_w
        self._heading_w = blend_heading(self._heading_w, to_gate_w, since_s)
        command = unpack_command(self._action_b)
        if self._kind == "acceleration":
            force_w = action_to_force(self._action_b, rot_w)
            command = attitude_command(self._vehicle.controller, force_w, rot_w, self._heading_w)
        thrust, rate_b = float(command.thrust[0]), command.rate_b[0]
        # A real autopilot's thrust is a share of its own maximum; docs/fly.md describes its
        # measurement.
        share = min(1.0, thrust / self._vehicle.full_thrust)
        sent = self._wire.encoded(SetPoint(rate_b, share))
        now = self._clock()
        self.rows.append(
            Row(
                state, thrust, rate_b, self._action_b[0], decided, self.gate,
                now - self._heard_at, now - state.time_s, image_age_s,
            )
        )  # fmt: skip
        return [sent]

    def _is_due(self, state: State) -> bool:
        """Return whether a decision is due at a state; missed decisions are not repeated.

        The policy's memory assumes a fixed time between decisions: several at once after a gap
        would count as more time than has passed.
        """
        since_s = state.time_s - self._begun_s + _SLACK_S
        now = int(since_s * self._policy.spec.rate_hz)
        if now < self._next:
            return False
        self.missed_decisions += now - self._next
        self._next = now + 1
        return True

    def _decide(self, state: State, rot_w: np.ndarray) -> str | None:
        """Let the policy decide; return why to hand over, or None."""
        depth = self._depth
        assert depth is not None
        count = len(self._gates.center_w)
        view = view_of(
            state.pos_w[None],
            rot_w,
            state.vel_w[None],
            _row(self._gates, self.gate),
            _row(self._gates, min(self.gate + 1, count - 1)),
            depth[None],
        )
        state_b, image = (
            np.asarray(x, np.float32) for x in observe(self._policy.spec, view, self._action_b)
        )
        fresh = np.array([self._fresh])
        limits = ActionLimits(deadline_s=self._limits.deadline_s)
        limits = limits_of(limits, self._policy.spec.action, self._vehicle)
        try:
            answer, self._hidden = self._policy.act(self._hidden, state_b, image, fresh)
            took_s = self._clock() - self._heard_at
            guarded = guard_action(limits, answer, self._action_b, took_s, self._policy.name)
        except Exception as error:  # on any error the vehicle must be handed over
            return f"the policy failed: {type(error).__name__}: {error}"
        self._action_b, self._fresh = guarded.action_b, False
        late = bool(guarded.late[0])
        self.late_answers += late
        self._late = self._late + 1 if late else 0
        if guarded.bad[0]:
            self.bad_actions += 1
            return "the policy's answer is not finite"
        if self._late >= self._limits.late_most:
            return f"{self._late} late answers in a row"
        return None


def _row(gates: Gates, number: int) -> Gates:
    return Gates(*(x[None, number] for x in gates))


class Row(NamedTuple):
    """State, decision and set point of the companion at one time."""

    state: State
    thrust: float
    """Wanted collective thrust per mass [m/s^2]."""
    rate_b: np.ndarray
    """(3,) wanted body rates [rad/s]."""
    action_b: np.ndarray
    """(3,) the policy's current action [m/s^2]."""
    decided: bool
    """Whether the policy decided on this state."""
    gate: int
    """Number of the next gate."""
    answered_s: float
    """Time from the state's arrival to its set point [s]."""
    state_age_s: float
    """Time from the state's stamp to its set point, if both ends have one clock [s]."""
    image_age_s: float
    """Time from the image's arrival to the decision [s]."""
