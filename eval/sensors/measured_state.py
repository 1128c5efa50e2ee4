"""Sensor model `measured_state`: errors of an estimated state, with own parameters for each axis.

`suite identify --sensors` fits these parameters to flights with motion capture. Position errors are
along world axes, velocity and attitude errors along body axes.
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
    length,
    noise_factor,
    product,
)
from tracks.geometry.rotation import exp_rot, to_world

GROUPS = {"position": ("m", 10.0), "velocity": ("m/s", 10.0), "attitude": ("rad", 0.5)}
"""Part of the state -> unit of its errors, and the largest allowed standard deviation."""
AXES = tuple(f"{group}_{axis}" for group in GROUPS for axis in "xyz")
"""Names of the nine errors, in the order of all arrays (..., 9) here."""
LASTS_S = 0.5
"""Default of the long correlation time [s]."""


class Axis(NamedTuple):
    """Parameters of the error along one axis, named `position_x`, `position_x_bias`, ...

    The noise has two parts: a fast one with a short, and a slow one with a long correlation time.
    """

    noise: Array
    """Standard deviation of the noise (both parts together), in the unit of the axis."""
    bias: Array
    """Standard deviation over trials of the constant error, in the unit of the axis."""
    fast: Array
    """Share of the noise's variance that the fast part has."""
    fast_lasts: Array
    """Correlation time of the fast part [s]; 0: independent at every observation."""
    lasts: Array
    """Correlation time of the slow part [s]."""


def _keys(axis: str) -> tuple[str, ...]:
    """Return the names of the parameters of one axis, in the order of `Axis`."""
    return (axis, *(f"{axis}_{name}" for name in Axis._fields[1:]))


_FIELDS = [*(name for axis in AXES for name in _keys(axis)), "velocity_scale", "position_drift"]
"""Names of all parameters: five of each axis, and two more."""
MeasuredState: Any = NamedTuple("MeasuredState", [(name, Array) for name in _FIELDS])  # pyrefly: ignore[bad-class-definition]
MeasuredState.__doc__ = "Parameters of `measured_state`: `Axis` for each axis, and two more."


def axes_of(values: Any) -> Axis:
    """Return the parameters of all axes; each field is (..., 9), in the order of `AXES`."""
    xp = values.velocity_scale.__array_namespace__()
    columns = zip(*([getattr(values, name) for name in _keys(axis)] for axis in AXES), strict=True)
    return Axis(*(xp.stack(list(column), axis=-1) for column in columns))


def start(values: Any, moment: Moment) -> dict[str, Any]:
    """Return the state at the start, by name.

    It holds noises and biases of unit variance (..., 9), and drift and position (..., 3).
    """
    draws, pos_w = moment.draws.normal, moment.truth.pos_w
    return {
        "slow": draws[..., :9],
        "fast": draws[..., 9:18],
        "bias": draws[..., 18:],
        "drift_w": 0.0 * pos_w,
        "pos_w": pos_w,
    }


def sense(
    values: Any, memory: dict[str, Any], seen: View, moment: Moment
) -> tuple[View, dict[str, Any]]:
    """Return the view with an estimated position, velocity and attitude, and the new state."""
    xp, axes, draws = seen.pos_w.__array_namespace__(), axes_of(values), moment.draws.normal
    slow = _next_error(memory["slow"], axes.lasts, draws[..., :9], moment.dt_s)
    fast = _next_error(memory["fast"], axes.fast_lasts, draws[..., 9:18], moment.dt_s)
    unit_noise = xp.sqrt(1.0 - axes.fast) * slow + xp.sqrt(axes.fast) * fast
    error = axes.noise * unit_noise + axes.bias * memory["bias"]
    flown_m = length(moment.truth.pos_w - memory["pos_w"])
    drift_w = memory["drift_w"] + column(values.position_drift * xp.sqrt(flown_m)) * draws[..., 18:]
    scaled_w = column(1.0 + values.velocity_scale) * seen.vel_w
    seen = seen._replace(
        pos_w=seen.pos_w + error[..., :3] + drift_w,
        vel_w=scaled_w + to_world(seen.rot_w, error[..., 3:6]),
        rot_w=product(seen.rot_w, exp_rot(error[..., 6:])),
    )
    changed_state = {"slow": slow, "fast": fast, "drift_w": drift_w, "pos_w": moment.truth.pos_w}
    return seen, memory | changed_state


def _next_error(error: Array, correlation_s: Array, draws: Array, dt_s: Any) -> Array:
    """Return first-order Gauss-Markov errors of unit variance after a step of `dt_s`."""
    xp = error.__array_namespace__()
    decay = xp.exp(-dt_s / xp.maximum(correlation_s, 1e-9))
    return decay * error + noise_factor(decay) * draws


def _parameters() -> tuple[Parameter, ...]:
    """Return the parameters of all axes, and the two that belong to no axis."""
    of_axes = []
    for group, (unit, largest) in GROUPS.items():
        usual = {"position": (0.01, 0.1), "velocity": (0.05, 0.3), "attitude": (0.005, 0.03)}[group]
        for axis in "xyz":
            noise, bias, fast, fast_lasts, lasts = _keys(f"{group}_{axis}")
            of_axes += [
                Parameter(noise, unit, 0.0, 0.0, largest, usual),
                Parameter(bias, unit, 0.0, 0.0, largest, usual),
                Parameter(fast, "1", 0.0, 0.0, 1.0, (0.05, 0.5)),
                Parameter(fast_lasts, "s", 0.0, 0.0, 1000.0, (0.01, 0.1)),
                Parameter(lasts, "s", LASTS_S, 0.0, 1000.0, (0.1, 2.0)),
            ]
    return (
        *of_axes,
        Parameter("velocity_scale", "1", 0.0, -0.5, 0.5, (0.005, 0.05)),
        Parameter("position_drift", "m/sqrt(m)", 0.0, 0.0, 10.0, (0.01, 0.1)),
    )


SENSOR = Sensor(
    name="measured_state",
    stage="state",
    summary="Errors of an estimated state: size, bias and correlation times for every axis",
    equation="p + b_p + n_p + d, (1 + k) v + R (b_v + n_v), R Exp(b_R + n_R); n = s (sqrt(f) e_f "
    "+ sqrt(1 - f) e), e' = a e + sqrt(1 - a^2) white, a = exp(-dt / lasts), e_f in the same way; "
    "d' = d + c sqrt(|dp|) white",
    source="first-order Gauss-Markov processes (Gelb 1974, Applied Optimal Estimation); the "
    "numbers by `suite identify --sensors`",
    values=MeasuredState,
    parameters=_parameters(),
    grows=(
        *(name for axis in AXES for name in _keys(axis)[:2]),
        "velocity_scale",
        "position_drift",
    ),
    trial=Needs(normal=27),
    observation=Needs(normal=21),
    start=start,
    sense=sense,
)
