"""Rotors that follow their command more slowly than the vehicle file says."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Constants, Effect, Parameter


class MotorLag(NamedTuple):
    """Values of `motor_lag`."""

    time_constant: Array
    """(...,) tau_m [s]."""


def constants_of(values: MotorLag, constants: Constants) -> Constants:
    """Return the constants with this rotor time constant in place of the vehicle file's."""
    return constants._replace(time_constant=values.time_constant)


EFFECT = Effect(
    name="motor_lag",
    summary="The rotors' time constant, in place of the vehicle file's",
    equation="dOmega/dt = (Omega_c - Omega) / tau_m",
    source="first-order motor model; Faessler, Falanga and Scaramuzza 2017",
    values=MotorLag,
    parameters=(
        Parameter(
            name="time_constant",
            unit="s",
            neutral=lambda vehicle: vehicle.rotors.time_constant,
            low=0.0,
            high=0.5,
            typical=(0.02, 0.06),
            whole=True,
        ),
    ),
    constants=constants_of,
    needs=("command",),
)
