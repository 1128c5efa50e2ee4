"""The effect of rotors with less thrust and torque: a worn motor, a damaged propeller."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from eval.effects.interface import Array, Effect, Parameter
from tracks.input.ranges import is_number, shown


class WeakMotor(NamedTuple):
    """Values of `weak_motor`; a vehicle file may give `index` (from 1) and `scale` of one rotor."""

    scale: Array
    """(..., 4) thrust and torque of each rotor, relative to nominal; with `index = 2`, a number for
    this rotor alone."""


def read(table: Mapping[str, Any]) -> WeakMotor:
    """Read `scale` of all rotors, or `index` and `scale`, from a vehicle file's table.

    Raises:
        ValueError: naming the key, its value and what is allowed.
    """
    for key in table:
        if key not in ("index", "scale"):
            raise ValueError(f"{key}: unknown key; allowed: index, scale")
    scale: Any = table.get("scale")
    index: Any = table.get("index", [1, 2, 3, 4] if isinstance(scale, list) else None)
    for key, value in (("index", index), ("scale", scale)):
        if value is None:
            raise ValueError(
                f"{key}: missing; give index = 2 and scale = 0.9, or a scale for each rotor: "
                "scale = [1.0, 0.9, 1.0, 1.0]"
            )
    entries = f"index = {shown(index)}, scale = {shown(scale)}"
    if isinstance(index, list) != isinstance(scale, list):
        raise ValueError(f"{entries}: must be both numbers or both lists")
    if not isinstance(index, list):
        index, scale = [index], [scale]
    if len(index) != len(scale) or not index:
        raise ValueError(f"{entries}: needed is one scale for each index")
    scales = [1.0] * 4
    for rotor, factor in zip(index, scale, strict=True):
        if isinstance(rotor, bool) or rotor not in (1, 2, 3, 4) or index.count(rotor) > 1:
            raise ValueError(
                f"index = {shown(index)}: allowed are different whole numbers from 1 to 4"
            )
        if not is_number(factor):
            raise ValueError(f"scale = {shown(factor)}: must be a finite number")
        scales[int(rotor) - 1] = float(factor)
    return WeakMotor(tuple(scales))


def write(values: WeakMotor) -> dict[str, Any]:
    """Return the vehicle file's table with the rotors whose scale is not 1."""
    if np.shape(values.scale) != (4,):
        raise ValueError(f"effects.weak_motor.scale is {shown(values.scale)}, allowed is 4 numbers")
    weak = [(i + 1, float(s)) for i, s in enumerate(values.scale) if s != 1.0] or [(1, 1.0)]
    if len(weak) == 1:
        return {"index": weak[0][0], "scale": weak[0][1]}
    return {"index": [i for i, _ in weak], "scale": [s for _, s in weak]}


WEAK_MOTOR = Effect(
    name="weak_motor",
    summary="One or several rotors give less thrust and torque than nominal",
    equation="thrust and torque of rotor i = scale_i x nominal",
    source="loss-of-effectiveness fault model of an actuator",
    values=WeakMotor,
    parameters=(
        Parameter(
            "scale",
            "1",
            neutral=1.0,
            low=0.0,
            high=1.5,
            typical=(0.03, 0.15),
            size=4,
            signs=(-1,),
            direction=(1.0, 0.0, 0.0, 0.0),
            one_at_a_time=True,
        ),
    ),
    constants=lambda values, constants: constants._replace(
        thrust_coefficient=constants.thrust_coefficient * values.scale,
        torque_coefficient=constants.torque_coefficient * values.scale,
    ),
    read=read,
    write=write,
)
