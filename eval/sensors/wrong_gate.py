"""The gate after the next one is taken for the next, for a while."""

from __future__ import annotations

from typing import NamedTuple

from eval.sensors.interface import (
    Array,
    Moment,
    Needs,
    Parameter,
    Sensor,
    View,
    absent,
    column,
    sticky,
)


class WrongGate(NamedTuple):
    """Values of `wrong_gate`."""

    share: Array
    length: Array


def sense(values: WrongGate, memory: Array, seen: View, moment: Moment) -> tuple[View, Array]:
    """Return the view with the second gate in the place of the first where it is taken for it."""
    xp, chance = seen.pos_w.__array_namespace__(), moment.draws.uniform[..., 0]
    wrong = sticky(memory, chance, values.share, values.length, moment.dt_s)
    gate_w = xp.where(column(wrong), seen.second_w, seen.gate_w)
    axis_w = xp.where(column(wrong), seen.second_axis_w, seen.axis_w)
    return seen._replace(gate_w=gate_w, axis_w=axis_w), wrong


SENSOR = Sensor(
    name="wrong_gate",
    stage="gates",
    summary="The gate after the next one is taken for the next, for a while",
    equation="Markov chain: wrong for `share` of the observations, `length` at a time",
    source="our estimate",
    values=WrongGate,
    parameters=(
        Parameter("share", "1", 0.0, 0.0, 0.95, (0.002, 0.02)),
        Parameter("length", "s", 0.0, 0.0, 10.0, (0.05, 0.3)),
    ),
    grows=("share",),
    trial=Needs(uniform=1),
    observation=Needs(uniform=1),
    start=absent,
    sense=sense,
)
