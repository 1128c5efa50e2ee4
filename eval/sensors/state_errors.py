"""Sensor models of an estimated state: `state_drift`, `state_noise`, `drag_tilt` and `delay`.

They are the drift of dead reckoning, coloured noise with a bias, a tilt error that drag causes, and
the delay of state and image.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from eval.effects.interface import GRAVITY
from eval.sensors.interface import (
    Ages,
    Array,
    Moment,
    Needs,
    Parameter,
    Sensor,
    View,
    column,
    length,
    noise_factor,
    product,
    rotation_since,
)
from tracks.geometry.rotation import cross, exp_rot, to_world, yaw_rotation

SMALL = 1e-3
"""Distances [m] and angles [rad] well below this add hardly any drift. So the slope of the square
root stays finite."""


class StateDrift(NamedTuple):
    """Parameters of `state_drift`; units in `STATE_DRIFT`, letters as in its `equation`."""

    position: Array
    """s_p: drift of the position, for each axis, over the root of the distance."""
    yaw: Array
    """s_y: drift of the heading over the root of the distance."""
    yaw_turning: Array
    """s_t: drift of the heading over the root of the turned angle."""
    scale: Array
    """k: standard deviation of the relative error of distances and velocity."""
    flown: Array
    """Distance flown before the trial."""


def state_drift_start(values: StateDrift, moment: Moment) -> dict[str, Any]:
    """Return the errors by the distance flown before the trial, and the pose at the start."""
    xp, draws = moment.draws.normal.__array_namespace__(), moment.draws.normal
    root_flown = xp.sqrt(values.flown)
    return {
        "scale": 1.0 + values.scale * draws[..., 0],
        "yaw": values.yaw * root_flown * draws[..., 1],
        "error_w": column(values.position * root_flown) * draws[..., 2:],
        "pos_w": moment.truth.pos_w,
        "rot_w": moment.truth.rot_w,
    }


def state_drift_sense(
    values: StateDrift, memory: dict[str, Any], seen: View, moment: Moment
) -> tuple[View, dict[str, Any]]:
    """Return the view with the state that dead reckoning estimates, and the model's new state."""
    truth, draws = moment.truth, moment.draws.normal
    step_w = truth.pos_w - memory["pos_w"]
    root_path = root(length(step_w))
    root_angle = root(length(rotation_since(truth.rot_w, memory["rot_w"])))
    yaw = memory["yaw"] + values.yaw * root_path * draws[..., 3]
    yaw = yaw + values.yaw_turning * root_angle * draws[..., 4]
    yaw_rot, scale = yaw_rotation(yaw), column(memory["scale"])
    error_w = memory["error_w"] + scale * to_world(yaw_rot, step_w) - step_w
    error_w = error_w + column(values.position * root_path) * draws[..., :3]
    seen = seen._replace(
        pos_w=seen.pos_w + error_w,
        vel_w=scale * to_world(yaw_rot, seen.vel_w),
        rot_w=product(yaw_rot, seen.rot_w),
    )
    changed_state = {"yaw": yaw, "error_w": error_w, "pos_w": truth.pos_w, "rot_w": truth.rot_w}
    return seen, memory | changed_state


def root(size: Array) -> Array:
    """Return the square root of sizes (...,), modified near zero so that its slope is finite."""
    xp = size.__array_namespace__()
    return size / xp.sqrt(size + SMALL)


STATE_DRIFT = Sensor(
    name="state_drift",
    stage="state",
    summary="Dead reckoning drifts with distance and rotation, and its scale has an error",
    equation="dp_est = (1 + k) Rz(psi) dp + s_p sqrt(|dp|) n, "
    "dpsi = s_y sqrt(|dp|) n + s_t sqrt(angle) n; v, R rotate with psi",
    source="Delmerico & Scaramuzza 2018, Delmerico et al. 2019 (UZH-FPV): about 0.5 to 2 % of "
    "the path after 100 m, hence 0.05 to 0.2 m after 1 m; yaw and scale: 0.1 to 1 deg after 1 m, "
    "about 1 %, our estimate",
    values=StateDrift,
    parameters=(
        Parameter("position", "m/m^0.5", 0.0, 0.0, 5.0, (0.01, 0.1)),
        Parameter("yaw", "rad/m^0.5", 0.0, 0.0, 0.5, (0.001, 0.01)),
        Parameter("yaw_turning", "rad^0.5", 0.0, 0.0, 0.5, (0.001, 0.01)),
        Parameter("scale", "1", 0.0, 0.0, 0.3, (0.003, 0.02)),
        Parameter("flown", "m", 0.0, 0.0, 1e5, (10.0, 100.0)),
    ),
    grows=("position", "yaw", "yaw_turning", "scale"),
    trial=Needs(normal=5),
    observation=Needs(normal=5),
    start=state_drift_start,
    sense=state_drift_sense,
)


class StateNoise(NamedTuple):
    """Parameters of `state_noise`; units in `STATE_NOISE`, letters as in its `equation`."""

    position: Array
    """s_p: standard deviation of the position, for each axis."""
    velocity: Array
    """s_v: standard deviation of the velocity, for each axis."""
    attitude: Array
    """s_R: standard deviation of the attitude, for each axis."""
    velocity_bias: Array
    """b_v: standard deviation of a trial's constant error of the velocity, for each body axis."""
    attitude_bias: Array
    """b_R: standard deviation of a trial's constant error of the attitude, for each body axis."""
    correlation: Array
    """Correlation time of the noise; 0: independent at every observation."""


def state_noise_start(values: StateNoise, moment: Moment) -> dict[str, Any]:
    """Return errors and biases of unit variance, by name.

    Errors (..., 9) are of position, velocity and attitude, biases (..., 6) of the latter two.
    """
    draws = moment.draws.normal
    return {"error": draws[..., :9], "bias": draws[..., 9:]}


def state_noise_sense(
    values: StateNoise, memory: dict[str, Any], seen: View, moment: Moment
) -> tuple[View, dict[str, Any]]:
    """Return the view with an estimated position, velocity and attitude, and the new state."""
    xp = seen.pos_w.__array_namespace__()
    decay = xp.exp(-moment.dt_s / xp.maximum(values.correlation, 1e-9))
    error = column(decay) * memory["error"] + column(noise_factor(decay)) * moment.draws.normal
    bias = memory["bias"]
    attitude_error_b = column(values.attitude) * error[..., 6:]
    attitude_error_b = attitude_error_b + column(values.attitude_bias) * bias[..., 3:]
    bias_b = column(values.velocity_bias) * bias[..., :3]
    vel_error_w = column(values.velocity) * error[..., 3:6] + to_world(seen.rot_w, bias_b)
    seen = seen._replace(
        pos_w=seen.pos_w + column(values.position) * error[..., :3],
        vel_w=seen.vel_w + vel_error_w,
        rot_w=product(seen.rot_w, exp_rot(attitude_error_b)),
    )
    return seen, {"error": error, "bias": bias}


STATE_NOISE = Sensor(
    name="state_noise",
    stage="state",
    summary="The estimated position, velocity and attitude have coloured noise and a bias",
    equation="e' = a e + sqrt(1 - a^2) n, a = exp(-dt / correlation); p + s_p e_p, "
    "v + s_v e_v + R b_v, R exp(s_R e_R + b_R)",
    source="per axis; Azhari et al. 2026 (ADR-VINS, TII-RATM): 0.13 m RMS over three axes with "
    "gate corrections; Delmerico & Scaramuzza 2018: VIO on EuRoC, 0.1 to 0.3 m and about 1 deg; "
    "the correlation time is our estimate",
    values=StateNoise,
    parameters=(
        Parameter("position", "m", 0.0, 0.0, 10.0, (0.01, 0.1)),
        Parameter("velocity", "m/s", 0.0, 0.0, 10.0, (0.05, 0.3)),
        Parameter("attitude", "rad", 0.0, 0.0, 0.5, (0.005, 0.03)),
        Parameter("velocity_bias", "m/s", 0.0, 0.0, 5.0, (0.02, 0.2)),
        Parameter("attitude_bias", "rad", 0.0, 0.0, 0.5, (0.005, 0.03)),
        Parameter("correlation", "s", 0.0, 0.0, 1000.0, (0.1, 2.0)),
    ),
    grows=("position", "velocity", "attitude", "velocity_bias", "attitude_bias"),
    trial=Needs(normal=15),
    observation=Needs(normal=9),
    start=state_noise_start,
    sense=state_noise_sense,
)


class DragTilt(NamedTuple):
    """Parameters of `drag_tilt`; units in `DRAG_TILT`."""

    drag: Array
    """Drag that the estimator neglects, as deceleration per speed."""
    lasts: Array
    """Time constant with which the estimator's tilt follows the apparent vertical."""


def drag_tilt_start(values: DragTilt, moment: Moment) -> dict[str, Any]:
    """Return the tilt error per unit of drag (..., 3) in steady flight [rad s], world axes."""
    del values
    return {"lean_w": _lean(moment.truth)}


def drag_tilt_sense(
    values: DragTilt, memory: dict[str, Any], seen: View, moment: Moment
) -> tuple[View, dict[str, Any]]:
    """Return the view with an attitude that is tilted by the neglected drag, and the new state."""
    xp = seen.pos_w.__array_namespace__()
    decay = column(xp.exp(-moment.dt_s / xp.maximum(values.lasts, 1e-9)))
    lean_w = decay * memory["lean_w"] + (1.0 - decay) * _lean(moment.truth)
    turn_w = exp_rot(column(values.drag) * lean_w)
    return seen._replace(rot_w=product(turn_w, seen.rot_w)), {"lean_w": lean_w}


def _lean(truth: View) -> Array:
    """Return the tilt error per unit of drag (..., 3) that the current velocity would cause."""
    return cross(truth.vel_w, truth.rot_w[..., 2]) / GRAVITY


DRAG_TILT = Sensor(
    name="drag_tilt",
    stage="state",
    summary="The estimator neglects drag and takes the deceleration for a tilt",
    equation="Exp(c q) R, dq/dt = (v x e / g - q) / lasts, e = R e_z",
    source="Leishman et al. 2014 (Quadrotors and accelerometers) of the cause; NanoBench (Ullah "
    "and Baca 2026) by `suite identify --sensors`: 0.4 1/s and 0.8 s; the rest is our estimate",
    values=DragTilt,
    parameters=(
        Parameter("drag", "1/s", 0.0, 0.0, 2.0, (0.1, 0.5)),
        Parameter("lasts", "s", 0.0, 0.0, 1000.0, (0.3, 2.0)),
    ),
    grows=("drag",),
    start=drag_tilt_start,
    sense=drag_tilt_sense,
)


class Delay(NamedTuple):
    """Parameters of `delay`."""

    state: float
    """Mean age of the state."""
    image: float
    """Mean age of the image."""
    jitter: float
    """Largest relative deviation of an age from its mean."""


def delay_ages(values: Delay) -> Ages:
    """Return the ages of state and image; `eval/judging/ages.py` selects the old views by them."""
    return Ages(*map(float, values))


DELAY = Sensor(
    name="delay",
    stage="state",
    summary="State and image are delayed when the policy decides",
    equation="seen(t) = true(t - a), a = age (1 + jitter u), u uniform from -1 to 1 each decision",
    source="Falanga et al. 2019 (latency of vision in flight): 10 to 100 ms",
    values=Delay,
    parameters=(
        Parameter("state", "s", 0.0, 0.0, 1.0, (0.005, 0.05)),
        Parameter("image", "s", 0.0, 0.0, 1.0, (0.01, 0.1)),
        Parameter("jitter", "1", 0.0, 0.0, 1.0, (0.1, 1.0)),
    ),
    grows=("state", "image"),
    ages=delay_ages,
)
