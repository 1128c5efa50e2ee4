"""Effects of the response to commands: slow rotors (motor lag), command delay, rate-loop gain."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Parameter


class MotorLag(NamedTuple):
    """Values of `motor_lag`."""

    time_constant: Array
    """(...,) tau_m: time constant with which the rotor speeds follow their commands [s]."""


MOTOR_LAG = Effect(
    name="motor_lag",
    summary="The rotors' time constant, in place of the vehicle file's",
    equation="dOmega/dt = (Omega_c - Omega) / tau_m",
    source="first-order motor model; Faessler, Falanga and Scaramuzza 2017",
    values=MotorLag,
    parameters=(
        Parameter(
            "time_constant",
            "s",
            neutral=lambda vehicle: vehicle.rotors.time_constant,
            low=0.0,
            high=0.5,
            typical=(0.02, 0.06),
            whole=True,
        ),
    ),
    constants=lambda values, constants: constants._replace(time_constant=values.time_constant),
    needs=("command",),
)


class CommandDelay(NamedTuple):
    """Values of `command_delay`."""

    delay: Array
    """(...,) additional delay of the commands [s]."""


COMMAND_DELAY = Effect(
    name="command_delay",
    summary="Commands act later",
    equation="command(t) acts at t + delay",
    source="transport delay of the command link",
    values=CommandDelay,
    parameters=(
        Parameter(
            "delay",
            "s",
            neutral=0.0,
            low=0.0,
            high=0.1,
            typical=(0.005, 0.04),
            tried=(0.01, 0.02, 0.03, 0.04),
        ),
    ),
    constants=lambda values, constants: constants._replace(delay=constants.delay + values.delay),
    needs=("command",),
)


class RateGain(NamedTuple):
    """Values of `rate_gain`."""

    scale: Array
    """(..., 3) true gain divided by nominal gain, about each body axis."""


RATE_GAIN = Effect(
    name="rate_gain",
    summary="True rate-loop gain over nominal",
    equation="K = scale x nominal, per axis",
    source="flight controller with other settings than assumed",
    values=RateGain,
    parameters=(
        Parameter(
            "scale", "1", neutral=1.0, low=0.1, high=5.0, typical=(0.1, 0.3), size=3, signs=(-1, 1)
        ),
    ),
    constants=lambda values, constants: constants._replace(
        rate_gain=constants.rate_gain * values.scale
    ),
    needs=("command",),
)
