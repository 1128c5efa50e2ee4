"""What robustness is measured under: every effect at its usual size, and growing disturbances."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from eval.effects import EFFECTS
from eval.effects.constant_wind import ConstantWind
from eval.effects.interface import Effect, neutral
from eval.judging.sensors import SensorNoise
from eval.vehicles.vehicle import Vehicle

SIGNS: Mapping[str, tuple[int, ...]] = MappingProxyType(
    {
        "thrust_scale": (-1, 1),
        "mass_offset": (1, -1),
        "inertia_scale": (1, -1),
        "rate_gain": (-1, 1),
        "weak_motor": (-1,),
    }
)
"""Ways in which an effect differs from its neutral values; upwards where nothing is said."""
DIRECTIONS: Mapping[str, tuple[float, ...]] = MappingProxyType(
    {
        "constant_wind": (-0.6, 0.8, 0.0),
        "com_offset": (0.6, 0.8, 0.0),
        "torque_trim": (0.6, 0.8, 0.0),
        "thrust_tilt": (0.6, 0.8),
        "frame_tilt": (0.6, 0.8),
        "weak_motor": (1.0, 0.0, 0.0, 0.0),
    }
)
"""Unit vectors along which an effect's components share its size; else each has all of it."""
STATE_UNIT = SensorNoise(pos_m=0.03, vel=0.1, attitude_rad=math.radians(1.0))
"""What 1 means in the sweep of the state's estimate."""


@dataclass(frozen=True)
class Condition:
    """A vehicle and sensors that differ from what the tables are flown on."""

    name: str
    """Of the effect or the sweep."""
    size: float
    """How strong, in the sweep's or the effect's unit."""
    words: str
    """The size for people, with its unit."""
    vehicle: Vehicle
    noise: SensorNoise = SensorNoise()


@dataclass(frozen=True)
class Sweep:
    """A disturbance that grows; its first point is what the tables are flown on."""

    name: str
    """For people."""
    axis: str
    """The size's meaning and unit."""
    sizes: Sequence[float]
    """Growing; the first is the undisturbed vehicle's own."""
    make: Callable[[Vehicle, float], tuple[Vehicle, SensorNoise]]
    """Returns what flies at one size."""


def log_faults() -> list[str]:
    """Return the effects that are faults of a log and touch no flight."""
    return [name for name, effect in EFFECTS.items() if effect.log is not None]


def effect_conditions(vehicle: Vehicle) -> list[Condition]:
    """Return `vehicle` with each effect that touches a flight, at the upper end of its usual size.

    Where the vehicle has more of an effect already, it keeps that.
    """
    found = []
    for effect in EFFECTS.values():
        if effect.log is None:
            found += [_with(vehicle, effect, sign) for sign in SIGNS.get(effect.name, (1,))]
    return found


def _with(vehicle: Vehicle, effect: Effect, sign: int) -> Condition:
    parameter = effect.parameters[0]
    values = neutral(effect, vehicle)
    size = parameter.typical[1]
    none = np.asarray(getattr(values, parameter.name), float)
    if effect.name == "motor_lag":
        none = np.zeros_like(none)  # its usual sizes are whole time constants
    share = np.asarray(DIRECTIONS.get(effect.name, np.ones(none.shape)))
    changed = none + sign * size * share
    if effect.name in vehicle.effects or effect.name == "motor_lag":
        own = np.asarray(getattr(_own(vehicle, effect.name), parameter.name), float)
        changed = np.where(np.abs(own - none) > np.abs(changed - none), own, changed)
    value = tuple(changed.tolist()) if changed.ndim else float(changed)
    shown = "(" + ", ".join(f"{v:.3g}" for v in changed) + ")" if changed.ndim else f"{value:.3g}"
    words = f"{parameter.name} {shown} {'' if parameter.unit == '1' else parameter.unit}".strip()
    changed_vehicle = with_effect(vehicle, effect.name, values._replace(**{parameter.name: value}))
    return Condition(effect.name, sign * size, words, changed_vehicle)


def with_effect(vehicle: Vehicle, name: str, values: Any) -> Vehicle:
    """Return `vehicle` with the effect `name` at `values` in place of its own."""
    return replace(vehicle, effects=MappingProxyType({**vehicle.effects, name: values}))


def _own(vehicle: Vehicle, name: str) -> Any:
    """Return the values of the effect `name` that `vehicle` has, neutral ones where it has none."""
    return vehicle.effects.get(name, neutral(EFFECTS[name], vehicle))


def sweep_conditions(vehicle: Vehicle, sweep: Sweep) -> list[Condition]:
    """Return the points of `sweep`; the first is `vehicle` as it is."""
    first = Condition(sweep.name, sweep.sizes[0], f"{sweep.sizes[0]:g}", vehicle)
    rest = [
        Condition(sweep.name, size, f"{size:g}", *sweep.make(vehicle, size))
        for size in sweep.sizes[1:]
    ]
    return [first, *rest]


def _effect(name: str, field: str, scale: float) -> Callable[..., tuple[Vehicle, SensorNoise]]:
    def make(vehicle: Vehicle, size: float) -> tuple[Vehicle, SensorNoise]:
        values = EFFECTS[name].values(**{field: scale * size})
        return with_effect(vehicle, name, values), SensorNoise()

    return make


def _heavier(vehicle: Vehicle, percent: float) -> tuple[Vehicle, SensorNoise]:
    values = EFFECTS["mass_offset"].values(offset=percent / 100 * vehicle.mass)
    return with_effect(vehicle, "mass_offset", values), SensorNoise()


def _draggier(vehicle: Vehicle, factor: float) -> tuple[Vehicle, SensorNoise]:
    for name in ("linear_drag", "quadratic_drag"):
        own = _own(vehicle, name)
        more = tuple(factor * value for value in own.coefficient)
        vehicle = with_effect(vehicle, name, own._replace(coefficient=more))
    return vehicle, SensorNoise()


def _windy(vehicle: Vehicle, speed: float) -> tuple[Vehicle, SensorNoise]:
    velocity = tuple(speed * share for share in DIRECTIONS["constant_wind"])
    return with_effect(vehicle, "constant_wind", ConstantWind(velocity)), SensorNoise()


def _sensing(field: str) -> Callable[..., tuple[Vehicle, SensorNoise]]:
    def make(vehicle: Vehicle, size: float) -> tuple[Vehicle, SensorNoise]:
        return vehicle, replace(SensorNoise(), **{field: size})

    return make


def _estimating(vehicle: Vehicle, factor: float) -> tuple[Vehicle, SensorNoise]:
    unit = STATE_UNIT
    return vehicle, replace(
        unit,
        pos_m=factor * unit.pos_m,
        vel=factor * unit.vel,
        attitude_rad=factor * unit.attitude_rad,
    )


def sweeps(vehicle: Vehicle) -> list[Sweep]:
    """Return the sweeps from what `vehicle` is."""
    lag = 1e3 * _own(vehicle, "motor_lag").time_constant
    delay = 1e3 * _own(vehicle, "command_delay").delay
    heavier = 100 * _own(vehicle, "mass_offset").offset / vehicle.mass
    wind = float(np.linalg.norm(_own(vehicle, "constant_wind").velocity))

    def more(first: float, *others: float) -> tuple[float, ...]:
        return (first, *(size for size in others if size > first))

    return [
        Sweep("motor lag", "rotor time constant [ms]", more(lag, 50, 80, 120, 180),
              _effect("motor_lag", "time_constant", 1e-3)),
        Sweep("latency", "command delay [ms]", more(delay, 50, 80, 120, 180),
              _effect("command_delay", "delay", 1e-3)),
        Sweep("mass", "mass above nominal [%]", more(heavier, 10, 20, 40, 60), _heavier),
        Sweep("drag", "drag, times the vehicle's own", (1, 2, 4, 8, 16), _draggier),
        Sweep("wind", "constant wind [m/s]", more(wind, 2, 4, 6, 8), _windy),
        Sweep("depth noise", "standard deviation of inverse depth [1/m]", (0, 0.01, 0.03, 0.1, 0.3),
              _sensing("inverse_depth")),
        Sweep("gate-pose error", "standard deviation per axis [m]", (0, 0.05, 0.1, 0.2, 0.3),
              _sensing("gate_m")),
        Sweep("state-estimation noise", "times 3 cm, 0.1 m/s, 1 deg", (0, 1, 2, 4, 8), _estimating),
    ]  # fmt: skip
