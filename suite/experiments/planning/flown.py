"""A plan flown by the judge's quadrotor in JAX: pilot, autopilot, rotors and body, with gradients.

What is flown is the stepper of the worlds, at their steps, under the command path of a policy: an
action at every step of the attitude loop, the heading towards the next gate.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from eval.effects.interface import GRAVITY
from eval.judging.guard import ActionLimits
from eval.quadrotor.attitude import level_heading
from eval.quadrotor.autopilot import Autopilot, AutopilotState, attitude_step
from eval.quadrotor.plant import Command, Motion
from eval.quadrotor.stepper import Inputs, hover_state, step
from suite.diagnose.plans.pilot import Gains, corrected
from suite.experiments.planning.course import Course, nearness, passing
from suite.experiments.planning.solver import FELT, SMOOTH, Judged
from suite.experiments.planning.spline import INTERVALS, Along, Spline, along, unpacked
from tracks.geometry.rotation import to_local
from tracks.geometry.scene import Array

GAINS = Gains(position=8.0, velocity=5.0, integral=0.0, correction=1e3)
"""Of the pilot: it has the true state and no noise, and what it flies is planned with it."""
AHEAD_S = 0.15
"""The acceleration is asked for so much earlier, about what the attitude is late [s]."""
LONGEST_ACTION = 0.999 * ActionLimits().size
"""Just what the judge does not shorten [m/s^2]."""
UPRIGHT = 0.06
"""Least z of body z: past 0 a trial has tipped [1]."""


UP_Z = 0.05
"""An excess of 1, of that [1]."""


class Ask(NamedTuple):
    """What the pilot is to follow at T moments."""

    here: Along
    """(T, 3) where to be."""
    acc_w: Array
    """(T, 3) acceleration a little later [m/s^2]."""


class Flown(NamedTuple):
    """A flight at T + 1 moments, one each step of the attitude loop."""

    pos_w: Array
    """(T + 1, 3) [m]."""
    vel_w: Array
    """(T + 1, 3) [m/s]."""
    up_z: Array
    """(T + 1,) z of body z in the world [1]."""


def asked(spline: Spline, time_s: Array) -> Ask:
    """Return what `spline` asks of the pilot at `time_s` (T,) [s]."""
    return Ask(along(spline, time_s), along(spline, time_s + AHEAD_S).acc_w)


def action(ask: Ask, pos_w: Array, rot_w: Array, vel_w: Array) -> Array:
    """Return the action (..., 3) in body axes that follows `ask` (..., 3) [m/s^2].

    It is no longer than the judge lets actions be, so that what is planned is what is flown.
    """
    xp = pos_w.__array_namespace__()
    off_w, slow_w = ask.here.pos_w - pos_w, ask.here.vel_w - vel_w
    action_b = to_local(rot_w, corrected(GAINS, ask.acc_w, off_w, slow_w))
    size = xp.sqrt((action_b**2).sum(-1, keepdims=True) + 1e-12)
    return action_b * xp.minimum(1.0, LONGEST_ACTION / size)


def start_motion(course: Course) -> Motion:
    """Return a drone at rest at the start, one row."""
    still = jnp.zeros((1, 3))
    return Motion(jnp.asarray(course.start_w)[None], jnp.asarray(course.rot_w)[None], still, still)


def fly(autopilot: Autopilot, course: Course, spline: Spline, passed_s: Array, ticks: int) -> Flown:
    """Fly `spline` for `ticks` steps of the attitude loop.

    Args:
        autopilot: the vehicle's.
        course: where it starts, and the gates that it heads to.
        spline: where to be.
        passed_s: (G,) when each gate is taken as passed, by the heading alone [s].
        ticks: how long.
    """
    every = autopilot.attitude_every
    period = every * autopilot.dt
    time_s = jnp.arange(ticks) * period
    motion = start_motion(course)
    plant = hover_state(autopilot.plant, (1,), jnp)
    hover = Command(jnp.full((1,), GRAVITY), jnp.zeros((1, 3)))
    state = AutopilotState(plant, hover, level_heading(motion.rot_w))
    number = jnp.minimum((time_s[:, None] > passed_s).sum(-1), len(passed_s) - 1)

    def tick(carry: Any, row: Any) -> tuple[Any, Any]:
        state, motion = carry
        count, ask, gate_w = row
        action_b = action(ask, motion.pos_w, motion.rot_w, motion.vel_w)
        state = attitude_step(autopilot, state, motion, action_b, gate_w, count)

        def physics(carry: Any, later: Array) -> tuple[Any, None]:
            inputs, at_s = Inputs(state.command), (count + later) * autopilot.dt
            now, body, _ = step(autopilot.plant, *carry, inputs=inputs, time_s=at_s)
            return (now, body), None

        (plant, motion), _ = jax.lax.scan(physics, (state.plant, motion), jnp.arange(every))
        state = state._replace(plant=plant)
        return (state, motion), (motion.pos_w[0], motion.vel_w[0], motion.rot_w[0, 2, 2])

    counts = (jnp.arange(ticks) * every)[:, None]
    rows = (counts, asked(spline, time_s), jnp.asarray(course.gates.center_w)[number])
    _, (pos_w, vel_w, up_z) = jax.lax.scan(tick, (state, motion), rows)

    def whole(first: Array, rest: Array) -> Array:
        return jnp.concatenate([jnp.asarray(first)[None], rest])

    return Flown(
        whole(motion.pos_w[0], pos_w), whole(motion.vel_w[0], vel_w), whole(jnp.ones(()), up_z)
    )


def flown_plan(
    autopilot: Autopilot, ticks: int, numbers: Array, rest: tuple[Course, Array]
) -> tuple[Judged, Array]:
    """Judge the spline of `numbers` by how it is flown, and say when it passes the gates (G,) [s].

    Args:
        autopilot: the vehicle's.
        ticks: how long is flown at most.
        numbers: of the spline.
        rest: the course, and (G,) when each gate is about passed [s].
    """
    course, passed_s = rest
    spline = unpacked(numbers)
    flown = fly(autopilot, course, spline, passed_s, ticks)
    period = autopilot.attitude_every * autopilot.dt
    gates = passing(course, flown.pos_w, period)
    lap_s = gates.time_s[-1]
    counts = (jnp.arange(ticks + 1) * period <= jax.lax.stop_gradient(lap_s)).astype(float)
    excess = [
        gates.excess.reshape(-1),
        nearness(course, flown.pos_w) * counts,
        (UPRIGHT - flown.up_z) * counts / UP_Z,
    ]
    off = [
        (lap_s - spline.duration_s)[None],
        SMOOTH * jnp.diff(spline.control_w, 3, axis=0).reshape(-1),
    ]
    share = jnp.linspace(0.0, 1.0, 3 * INTERVALS + 1) * spline.duration_s
    felt = along(spline, share).acc_w.reshape(-1) / FELT
    return Judged(lap_s, jnp.concatenate(excess), jnp.concatenate(off), felt), gates.time_s
