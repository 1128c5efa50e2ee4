"""Effects of the body: mass, inertia or centre of mass differ from nominal; a constant torque."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Parameter


class MassOffset(NamedTuple):
    """Values of `mass_offset`."""

    offset: Array
    """(...,) true mass minus nominal mass [kg]."""


MASS_OFFSET = Effect(
    name="mass_offset",
    summary="Heavier or lighter than nominal",
    equation="m = nominal + offset",
    source="payload, another battery",
    values=MassOffset,
    parameters=(
        Parameter(
            "offset",
            "kg",
            neutral=0.0,
            low=lambda vehicle: -0.5 * vehicle.mass,
            high=lambda vehicle: vehicle.mass,
            typical=(0.04, 0.2),
            signs=(1, -1),
        ),
    ),
    # The inertia is unchanged.
    constants=lambda values, constants: constants._replace(mass=constants.mass + values.offset),
)


class ComOffset(NamedTuple):
    """Values of `com_offset`."""

    offset: Array
    """(..., 3) true centre of mass minus nominal one, body axes [m]."""


COM_OFFSET = Effect(
    name="com_offset",
    summary="The centre of mass lies off the nominal one",
    equation="rotor arms become r_i - d",
    source="battery position",
    values=ComOffset,
    parameters=(
        Parameter(
            "offset",
            "m",
            neutral=0.0,
            low=-0.05,
            high=0.05,
            typical=(0.002, 0.01),
            size=3,
            unseen=(2,),
            direction=(0.6, 0.8, 0.0),
        ),
    ),
    # Positions in logs and in the simulation refer to the true centre of mass, as does the inertia.
    constants=lambda values, constants: constants._replace(
        com_offset_b=constants.com_offset_b + values.offset,
        rotor_position_b=constants.rotor_position_b - values.offset[..., None, :],
    ),
)


class TorqueTrim(NamedTuple):
    """Values of `torque_trim`."""

    torque: Array
    """(..., 3) torque about body x, y, z [N m]."""


TORQUE_TRIM = Effect(
    name="torque_trim",
    summary="A constant body torque",
    equation="tau_b += torque",
    source="definition",
    values=TorqueTrim,
    parameters=(
        Parameter(
            "torque",
            "N m",
            neutral=0.0,
            low=-0.5,
            high=0.5,
            typical=(0.005, 0.05),
            size=3,
            direction=(0.6, 0.8, 0.0),
        ),
    ),
    torque=lambda values, flow: values.torque,
)


class InertiaScale(NamedTuple):
    """Values of `inertia_scale`."""

    scale: Array
    """(..., 3) true inertia divided by nominal inertia, about each body axis."""


INERTIA_SCALE = Effect(
    name="inertia_scale",
    summary="True inertia over nominal",
    equation="J = scale x nominal, per axis",
    source="inertia measured or guessed badly",
    values=InertiaScale,
    parameters=(
        Parameter(
            "scale",
            "1",
            neutral=1.0,
            low=0.2,
            high=5.0,
            typical=(0.05, 0.25),
            size=3,
            signs=(1, -1),
        ),
    ),
    constants=lambda values, constants: constants._replace(
        inertia=constants.inertia * values.scale
    ),
)
