"""Effects on the thrust: a scale, a falling battery voltage, a tilted direction."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Flow, Parameter, per_axis, tilted_e3


class ThrustScale(NamedTuple):
    """Values of `thrust_scale`."""

    scale: Array
    """(...,) true thrust coefficient k_T divided by nominal k_T."""


THRUST_SCALE = Effect(
    name="thrust_scale",
    summary="Thrust larger or smaller than nominal",
    equation="k_T = scale x nominal, k_Q unchanged",
    source="thrust curve off by a factor",
    values=ThrustScale,
    parameters=(
        Parameter(
            "scale", "1", neutral=1.0, low=0.3, high=2.0, typical=(0.05, 0.15), signs=(-1, 1)
        ),
    ),
    constants=lambda values, constants: constants._replace(
        thrust_coefficient=constants.thrust_coefficient * per_axis(values.scale)
    ),
)


class BatterySag(NamedTuple):
    """Values of `battery_sag`."""

    rate: Array
    """(...,) share of the thrust that is lost per second [1/s]."""
    per_volt: Array
    """(...,) share of the thrust that is lost per volt below the first voltage [1/V]."""


def battery_sag_thrust(values: BatterySag, flow: Flow, thrust: Array) -> Array:
    """Return the thrusts (..., 4) [N] times 1 - rate t, or 1 - per_volt (V0 - V).

    V0 is the first voltage. If the voltage is known and `per_volt` is not zero, only the voltage
    counts; otherwise `rate` is used.
    """
    xp = thrust.__array_namespace__()
    by_time = values.rate * flow.time_s
    if flow.voltage_drop is None:
        lost = by_time
    else:
        # Written as a sum, so that the gradient for per_volt exists at 0, where a fit starts.
        lost = values.per_volt * flow.voltage_drop + xp.where(values.per_volt == 0.0, by_time, 0.0)
    return thrust * per_axis(xp.maximum(xp.asarray(1.0 - lost), 0.0))


BATTERY_SAG = Effect(
    name="battery_sag",
    summary="Thrust decreases while the battery discharges",
    equation="rotor thrust x (1 - rate t), or x (1 - per_volt (V0 - V))",
    source="convention",
    values=BatterySag,
    parameters=(
        Parameter(
            "rate",
            "1/s",
            neutral=0.0,
            low=0.0,
            high=0.05,
            typical=(2e-4, 2e-3),
            required=False,
            voltage=False,
        ),
        Parameter(
            "per_volt",
            "1/V",
            neutral=0.0,
            low=0.0,
            high=1.0,
            typical=(0.02, 0.15),
            required=False,
            voltage=True,
        ),
    ),
    thrust=battery_sag_thrust,
    slow=True,
    with_voltage=lambda values, fall: BatterySag(0.0, values.rate / fall),
)


class ThrustTilt(NamedTuple):
    """Values of `thrust_tilt`."""

    angle: Array
    """(..., 2) tilt of the thrust about body x, then y [rad]."""


THRUST_TILT = Effect(
    name="thrust_tilt",
    summary="The total thrust is tilted, with unchanged torques",
    equation="F_thrust = (sum f_i) Rot(a_x, a_y, 0) e3",
    source="body frame misaligned with the rotors",
    values=ThrustTilt,
    parameters=(
        Parameter(
            "angle",
            "rad",
            neutral=0.0,
            low=-0.35,
            high=0.35,
            typical=(0.0035, 0.035),
            size=2,
            direction=(0.6, 0.8),
        ),
    ),
    constants=lambda values, constants: constants._replace(thrust_axis_b=tilted_e3(values.angle)),
)
