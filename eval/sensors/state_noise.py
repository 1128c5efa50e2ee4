"""Errors of the estimated state: coloured noise, and a constant bias in each trial."""

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
    product,
    remembered,
)
from tracks.geometry.rotation import exp_rot, to_world


class StateNoise(NamedTuple):
    """Values of `state_noise`."""

    position: Array
    velocity: Array
    attitude: Array
    velocity_bias: Array
    attitude_bias: Array
    correlation: Array


def start(values: StateNoise, moment: Moment) -> dict[str, Any]:
    """Return unit errors (..., 9) of position, velocity and attitude, and biases (..., 6)."""
    draws = moment.draws.normal
    return {"error": draws[..., :9], "bias": draws[..., 9:]}


def sense(
    values: StateNoise, memory: dict[str, Any], seen: View, moment: Moment
) -> tuple[View, dict[str, Any]]:
    """Return the view with an estimated position, velocity and attitude."""
    xp = seen.pos_w.__array_namespace__()
    kept = xp.exp(-moment.dt_s / xp.maximum(values.correlation, 1e-9))
    error = column(kept) * memory["error"] + column(remembered(kept)) * moment.draws.normal
    bias = memory["bias"]
    turn_b = column(values.attitude) * error[..., 6:] + column(values.attitude_bias) * bias[..., 3:]
    drift_b = column(values.velocity_bias) * bias[..., :3]
    velocity_w = column(values.velocity) * error[..., 3:6] + to_world(seen.rot_w, drift_b)
    seen = seen._replace(
        pos_w=seen.pos_w + column(values.position) * error[..., :3],
        vel_w=seen.vel_w + velocity_w,
        rot_w=product(seen.rot_w, exp_rot(turn_b)),
    )
    return seen, {"error": error, "bias": bias}


SENSOR = Sensor(
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
    start=start,
    sense=sense,
)
