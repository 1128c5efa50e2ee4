"""Commands take their time through radio, computer and motor controllers."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Constants, Effect, Parameter


class CommandDelay(NamedTuple):
    """Values of `command_delay`."""

    delay: Array
    """(...,) how much later a command acts [s]."""


def constants_of(values: CommandDelay, constants: Constants) -> Constants:
    """Return the constants with this delay added."""
    return constants._replace(delay=constants.delay + values.delay)


EFFECT = Effect(
    name="command_delay",
    summary="Commands act later",
    equation="command(t) acts at t + delay",
    source="transport delay of the command link",
    values=CommandDelay,
    parameters=(
        Parameter(
            name="delay",
            unit="s",
            neutral=0.0,
            low=0.0,
            high=0.1,
            typical=(0.005, 0.04),
        ),
    ),
    constants=constants_of,
    needs=("command",),
)
