"""Intermittent faults: lost track, a wrong gate, a blind camera, lost images.

Each is a two-state Markov chain (`sticky`): present for `share` of the observations, for `length`
at a time.
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
    over_image,
    sticky,
)


class StateLoss(NamedTuple):
    """Values of `state_loss`."""

    share: Array
    """Share of the observations without track."""
    length: Array
    """Mean duration of a loss."""
    acceleration: Array
    """a: standard deviation of the acceleration with which the estimate runs away."""
    jump: Array
    """Standard deviation of the position's jump at the end, for each axis."""


def state_loss_start(values: StateLoss, moment: Moment) -> dict[str, Any]:
    """Return the state at the start: on track, without errors."""
    none_w = 0.0 * moment.truth.pos_w
    lost = absent(values, moment)
    return {"lost": lost, "acc_w": none_w, "vel_w": none_w, "pos_w": none_w, "jump_w": none_w}


def state_loss_sense(
    values: StateLoss, memory: dict[str, Any], seen: View, moment: Moment
) -> tuple[View, dict[str, Any]]:
    """Return the view with the estimator's state; each loss of track leaves a jump."""
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


STATE_LOSS = Sensor(
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
    start=state_loss_start,
    sense=state_loss_sense,
)


class Fault(NamedTuple):
    """Values of the faults below."""

    share: Array
    """Share of the observations with the fault."""
    length: Array
    """Mean duration of the fault."""


def _fault(usual_share: tuple[float, float], **others: Any) -> Sensor:
    """Return a sensor model with the parameters `share` and `length` alone."""
    return Sensor(
        source="our estimate",
        values=Fault,
        parameters=(
            Parameter("share", "1", 0.0, 0.0, 0.95, usual_share),
            Parameter("length", "s", 0.0, 0.0, 10.0, (0.05, 0.3)),
        ),
        grows=("share",),
        trial=Needs(uniform=1),
        observation=Needs(uniform=1),
        **others,
    )


def wrong_gate_sense(
    values: Fault, memory: Array, seen: View, moment: Moment
) -> tuple[View, Array]:
    """Return the view with the second gate in place of the first during the fault."""
    xp, chance = seen.pos_w.__array_namespace__(), moment.draws.uniform[..., 0]
    wrong = sticky(memory, chance, values.share, values.length, moment.dt_s)
    gate_w = xp.where(column(wrong), seen.second_w, seen.gate_w)
    axis_w = xp.where(column(wrong), seen.second_axis_w, seen.axis_w)
    return seen._replace(gate_w=gate_w, axis_w=axis_w), wrong


WRONG_GATE = _fault(
    usual_share=(0.002, 0.02),
    name="wrong_gate",
    stage="gates",
    summary="The gate after the next one is taken for the next, for a while",
    equation="Markov chain: wrong for `share` of the observations, `length` at a time",
    start=absent,
    sense=wrong_gate_sense,
)


def exposure_sense(values: Fault, memory: Array, seen: View, moment: Moment) -> tuple[View, Array]:
    """Return the view with an image at full range where the camera is blind."""
    xp, chance = seen.depth_m.__array_namespace__(), moment.draws.uniform[..., 0]
    blind = sticky(memory, chance, values.share, values.length, moment.dt_s)
    depth_m = xp.where(over_image(blind), moment.camera.range_m, seen.depth_m)
    return seen._replace(depth_m=depth_m), blind


EXPOSURE = _fault(
    usual_share=(0.005, 0.05),
    name="exposure",
    stage="depth",
    summary="The camera is blind for a while; its image reads as the range everywhere",
    equation="Markov chain: blind for `share` of the images, `length` at a time; z = range",
    start=absent,
    sense=exposure_sense,
)


def frame_loss_start(values: Fault, moment: Moment) -> dict[str, Any]:
    """Return the state at the start: no image is lost."""
    return {"lost": absent(values, moment), "shown_m": moment.truth.depth_m}


def frame_loss_sense(
    values: Fault, memory: dict[str, Any], seen: View, moment: Moment
) -> tuple[View, dict[str, Any]]:
    """Return the view with the last image that was not lost."""
    xp = seen.depth_m.__array_namespace__()
    chance = moment.draws.uniform[..., 0]
    lost = sticky(memory["lost"], chance, values.share, values.length, moment.dt_s)
    shown_m = xp.where(over_image(lost), memory["shown_m"], seen.depth_m)
    return seen._replace(depth_m=shown_m), {"lost": lost, "shown_m": shown_m}


FRAME_LOSS = _fault(
    usual_share=(0.01, 0.1),
    name="frame_loss",
    stage="depth",
    summary="Images are lost, alone or in bursts, and the one before is seen again",
    equation="Markov chain: lost for `share` of the images, `length` at a time; z = z of the last",
    start=frame_loss_start,
    sense=frame_loss_sense,
)
