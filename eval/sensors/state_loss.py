"""An estimator that loses track: its state runs away by the inertial sensors alone, and is reset.

While it is lost, an error of the acceleration grows into velocity and position. When it is found
again both are gone, and the position jumps: that jump stays.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from eval.sensors.interface import (
    Array,
    Moment,
    Needs,
    Parameter,
    Sensor,
    View,
    absent,
    column,
    sticky,
)


class StateLoss(NamedTuple):
    """Values of `state_loss`."""

    share: Array
    length: Array
    acceleration: Array
    jump: Array


def start(values: StateLoss, moment: Moment) -> dict[str, Any]:
    """Return that the estimator has track, and no errors."""
    none_w = 0.0 * moment.truth.pos_w
    lost = absent(values, moment)
    return {"lost": lost, "acc_w": none_w, "vel_w": none_w, "pos_w": none_w, "jump_w": none_w}


def sense(
    values: StateLoss, memory: dict[str, Any], seen: View, moment: Moment
) -> tuple[View, dict[str, Any]]:
    """Return the view with the state as the estimator has it."""
    xp, draws, dt_s = seen.pos_w.__array_namespace__(), moment.draws, moment.dt_s
    was = column(memory["lost"])
    chance = draws.uniform[..., 0]
    lost = sticky(memory["lost"], chance, values.share, values.length, dt_s)
    now = column(lost)
    fresh_w = column(values.acceleration) * draws.normal[..., :3]
    acc_w = xp.where(was, memory["acc_w"], fresh_w)
    vel_w = xp.where(now, memory["vel_w"] + acc_w * dt_s, 0.0)
    pos_w = xp.where(now, memory["pos_w"] + vel_w * dt_s, 0.0)
    jumped_w = memory["jump_w"] + column(values.jump) * draws.normal[..., 3:]
    jump_w = xp.where(was & ~now, jumped_w, memory["jump_w"])
    seen = seen._replace(pos_w=seen.pos_w + pos_w + jump_w, vel_w=seen.vel_w + vel_w)
    return seen, {"lost": lost, "acc_w": acc_w, "vel_w": vel_w, "pos_w": pos_w, "jump_w": jump_w}


SENSOR = Sensor(
    name="state_loss",
    stage="state",
    summary="The estimator loses track for a while, runs away, and is reset with a jump",
    equation="Markov chain; lost: v + a t, p + a t^2 / 2, normal a; found again: p + normal jump",
    source="our estimate: the acceleration is that of 2 deg of tilt and an accelerometer's bias",
    values=StateLoss,
    parameters=(
        Parameter("share", "1", 0.0, 0.0, 0.95, (0.005, 0.05)),
        Parameter("length", "s", 0.0, 0.0, 10.0, (0.1, 0.5)),
        Parameter("acceleration", "m/s^2", 0.0, 0.0, 20.0, (0.2, 1.0)),
        Parameter("jump", "m", 0.0, 0.0, 10.0, (0.02, 0.2)),
    ),
    grows=("share", "acceleration", "jump"),
    trial=Needs(uniform=1),
    observation=Needs(normal=6, uniform=1),
    start=start,
    sense=sense,
)
