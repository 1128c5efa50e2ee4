"""Thrust that falls while the battery empties, by time or by its voltage."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Flow, Parameter, per_axis


class BatterySag(NamedTuple):
    """Values of `battery_sag`."""

    rate: Array
    """(...,) share of thrust lost a second [1/s]."""
    per_volt: Array
    """(...,) share of thrust lost a volt below the first voltage [1/V]."""


def thrust_of(values: BatterySag, flow: Flow, thrust: Array) -> Array:
    """Return the thrusts (..., 4) [N] times 1 - rate t, or 1 - per_volt (V0 - V).

    Where there is a voltage and `per_volt` is not zero, the voltage alone counts; a judge without
    voltage uses `rate`.
    """
    xp = thrust.__array_namespace__()
    by_time = values.rate * flow.time_s
    if flow.voltage_drop is None:
        lost = by_time
    else:
        # Both terms keep their slope at per_volt = 0, where a fit starts.
        lost = values.per_volt * flow.voltage_drop + xp.where(values.per_volt == 0.0, by_time, 0.0)
    return thrust * per_axis(xp.maximum(xp.asarray(1.0 - lost), 0.0))


def with_voltage(values: BatterySag, fall: float) -> BatterySag:
    """Return the loss a volt that is `values.rate` where the voltage falls by `fall` [V/s]."""
    return BatterySag(0.0, values.rate / fall)


EFFECT = Effect(
    name="battery_sag",
    summary="Thrust falls while the battery empties",
    equation="rotor thrust x (1 - rate t), or x (1 - per_volt (V0 - V))",
    source="convention",
    values=BatterySag,
    parameters=(
        Parameter(
            name="rate",
            unit="1/s",
            neutral=0.0,
            low=0.0,
            high=0.05,
            typical=(2e-4, 2e-3),
            required=False,
            voltage=False,
        ),
        Parameter(
            name="per_volt",
            unit="1/V",
            neutral=0.0,
            low=0.0,
            high=1.0,
            typical=(0.02, 0.15),
            required=False,
            voltage=True,
        ),
    ),
    thrust=thrust_of,
    slow=True,
    with_voltage=with_voltage,
)
