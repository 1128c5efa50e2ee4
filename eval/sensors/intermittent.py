"""Sensor models of intermittent faults: lost track, a wrong gate, a blind camera, lost images.

Each is a two-state Markov chain (`markov_step`): in the long run the fault is present in `share` of
the observations, for `length` seconds at a time on average.
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
    column,
    markov_step,
    over_image,
    starts_absent,
)


class StateLoss(NamedTuple):
    """Parameters of `state_loss`; units in `STATE_LOSS`."""

    share: Array
    """Share of the observations in which the estimator has lost track."""
    length: Array
    """Mean duration of a loss of track."""
    acceleration: Array
    """a: standard deviation of the acceleration with which the estimate leaves the true path."""
    jump: Array
    """Standard deviation of the position's jump at the end of a loss, for each axis."""


def state_loss_start(values: StateLoss, moment: Moment) -> dict[str, Any]:
    """Return the state at the start: on track, without errors."""
    zero_w = 0.0 * moment.truth.pos_w
    lost = starts_absent(values, moment)
    return {"lost": lost, "acc_w": zero_w, "vel_w": zero_w, "pos_w": zero_w, "jump_w": zero_w}


def state_loss_sense(
    values: StateLoss, memory: dict[str, Any], seen: View, moment: Moment
) -> tuple[View, dict[str, Any]]:
    """Return the view with the estimator's state, and the model's new state.

    Each loss of track leaves a jump of the position.
    """
    xp, draws, dt_s = seen.pos_w.__array_namespace__(), moment.draws, moment.dt_s
    lost = _is_present(values, memory["lost"], moment)
    lost_before, lost_now = column(memory["lost"]), column(lost)
    new_acc_w = column(values.acceleration) * draws.normal[..., :3]
    acc_w = xp.where(lost_before, memory["acc_w"], new_acc_w)
    vel_w = xp.where(lost_now, memory["vel_w"] + acc_w * dt_s, 0.0)
    pos_w = xp.where(lost_now, memory["pos_w"] + vel_w * dt_s, 0.0)
    new_jump_w = memory["jump_w"] + column(values.jump) * draws.normal[..., 3:]
    jump_w = xp.where(lost_before & ~lost_now, new_jump_w, memory["jump_w"])
    seen = seen._replace(pos_w=seen.pos_w + pos_w + jump_w, vel_w=seen.vel_w + vel_w)
    return seen, {"lost": lost, "acc_w": acc_w, "vel_w": vel_w, "pos_w": pos_w, "jump_w": jump_w}


STATE_LOSS = Sensor(
    name="state_loss",
    stage="state",
    summary="The estimator loses track for a while, diverges, and is reset with a jump",
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
    """Parameters of `wrong_gate`, `exposure` and `frame_loss`."""

    share: Array
    """Share of the observations with the fault."""
    length: Array
    """Mean duration of the fault."""


def _fault(usual_share: tuple[float, float], **fields: Any) -> Sensor:
    """Return a sensor model with the parameters of `Fault`, and the other `fields` of `Sensor`."""
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
        **fields,
    )


def _is_present(values: Any, present: Array, moment: Moment) -> Array:
    """Return whether the fault is present at this observation, bool (...,)."""
    chance = moment.draws.uniform[..., 0]
    return markov_step(present, chance, values.share, values.length, moment.dt_s)


def wrong_gate_sense(
    values: Fault, memory: Array, seen: View, moment: Moment
) -> tuple[View, Array]:
    """Return the view with the second gate in place of the first one during the fault."""
    xp, is_wrong = seen.pos_w.__array_namespace__(), _is_present(values, memory, moment)
    gate_w = xp.where(column(is_wrong), seen.second_w, seen.gate_w)
    axis_w = xp.where(column(is_wrong), seen.second_axis_w, seen.axis_w)
    return seen._replace(gate_w=gate_w, axis_w=axis_w), is_wrong


WRONG_GATE = _fault(
    usual_share=(0.002, 0.02),
    name="wrong_gate",
    stage="gates",
    summary="The gate after the next one is taken for the next, for a while",
    equation="Markov chain: wrong for `share` of the observations, `length` at a time",
    start=starts_absent,
    sense=wrong_gate_sense,
)


def exposure_sense(values: Fault, memory: Array, seen: View, moment: Moment) -> tuple[View, Array]:
    """Return the view with an image that is at full range everywhere during the fault."""
    xp, blind = seen.depth_m.__array_namespace__(), _is_present(values, memory, moment)
    depth_m = xp.where(over_image(blind), moment.camera.range_m, seen.depth_m)
    return seen._replace(depth_m=depth_m), blind


EXPOSURE = _fault(
    usual_share=(0.005, 0.05),
    name="exposure",
    stage="depth",
    summary="The camera is blind for a while; its image reads as the range everywhere",
    equation="Markov chain: blind for `share` of the images, `length` at a time; z = range",
    start=starts_absent,
    sense=exposure_sense,
)


def frame_loss_start(values: Fault, moment: Moment) -> dict[str, Any]:
    """Return the state at the start: no image is lost, and there is no last one."""
    absent = starts_absent(values, moment)
    return {"lost": absent, "shown_m": moment.truth.depth_m, "has_image": absent}


def frame_loss_sense(
    values: Fault, memory: dict[str, Any], seen: View, moment: Moment
) -> tuple[View, dict[str, Any]]:
    """Return the view with the last image that was not lost; the first one is never lost."""
    xp, lost = seen.depth_m.__array_namespace__(), _is_present(values, memory["lost"], moment)
    repeated = over_image(lost & memory["has_image"])
    shown_m = xp.where(repeated, memory["shown_m"], seen.depth_m)
    memory = {"lost": lost, "shown_m": shown_m, "has_image": memory["has_image"] | True}
    return seen._replace(depth_m=shown_m), memory


FRAME_LOSS = _fault(
    usual_share=(0.01, 0.1),
    name="frame_loss",
    stage="depth",
    summary="Images are lost, singly or in bursts, and the last image is repeated",
    equation="Markov chain: lost for `share` of the images, `length` at a time; z = z of the last",
    start=frame_loss_start,
    sense=frame_loss_sense,
)
