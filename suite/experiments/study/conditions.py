"""Conditions of robustness: every effect at its usual size, and growing disturbances."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from eval.effects import EFFECTS
from eval.effects.interface import Effect, bound_value, neutral
from eval.effects.wind import CONSTANT_WIND
from eval.sensors.sensors_file import PERFECT, SensorSet, sensor_set
from eval.vehicles.vehicle import Vehicle

STATE_UNIT = {"position": 0.03, "velocity": 0.1, "attitude": math.radians(1.0)}
"""Errors at size 1 in the sweep of the state estimate."""
DRAGS = ("linear_drag", "quadratic_drag", "rotor_drag")
"""Effects that grow in the sweep of drag, if the vehicle has them."""


@dataclass(frozen=True)
class Condition:
    """A vehicle, sensors and a simulator other than those of the result tables."""

    name: str
    """Name of the effect or the sweep."""
    size: float
    """Size, in the unit of the sweep or the effect."""
    words: str
    """Size as text, with its unit."""
    vehicle: Vehicle
    sensors: SensorSet = PERFECT
    simulator: str = "mujoco"


@dataclass(frozen=True)
class Sweep:
    """A disturbance of growing size; its first point is the undisturbed vehicle."""

    name: str
    """Title of the chart."""
    axis: str
    """What the size is, with its unit."""
    sizes: Sequence[float]
    """In increasing order; the first is the vehicle's own."""
    make: Callable[[Vehicle, float], tuple[Vehicle, SensorSet]]
    """Returns vehicle and sensors of a size."""


def effect_conditions(vehicle: Vehicle) -> list[Condition]:
    """Return `vehicle` with each effect that changes a flight, at the upper end of its usual size.

    A larger value of the vehicle's own is kept, and the size is limited to what is physical: a
    vehicle of 27 g cannot lose 0.2 kg. The effect's other parameters stay.
    """
    found = []
    for effect in EFFECTS.values():
        if effect.in_flight:
            found += [_with(vehicle, effect, sign) for sign in effect.parameters[0].signs]
    return found


def _with(vehicle: Vehicle, effect: Effect, sign: int) -> Condition:
    parameter = effect.parameters[0]
    values = _own(vehicle, effect.name)
    size = parameter.typical[1]
    none = np.asarray(getattr(neutral(effect, vehicle), parameter.name), float)
    none = np.zeros_like(none) if parameter.whole else none
    share = np.asarray(parameter.direction) if parameter.direction else np.ones(none.shape)
    changed = none + sign * size * share
    changed = np.clip(
        changed, bound_value(parameter.low, vehicle), bound_value(parameter.high, vehicle)
    )
    own = np.asarray(getattr(values, parameter.name), float)
    changed = np.where(np.abs(own - none) > np.abs(changed - none), own, changed)
    value = _plain(changed)
    shown = "(" + ", ".join(f"{v:.3g}" for v in changed) + ")" if changed.ndim else f"{value:.3g}"
    words = f"{parameter.name} {shown} {'' if parameter.unit == '1' else parameter.unit}".strip()
    changed_vehicle = with_effect(vehicle, effect.name, values._replace(**{parameter.name: value}))
    return Condition(effect.name, sign * size, words, changed_vehicle)


def with_effect(vehicle: Vehicle, name: str, values: Any) -> Vehicle:
    """Return `vehicle` with the effect `name` at `values` in place of its own."""
    return replace(vehicle, effects=MappingProxyType({**vehicle.effects, name: values}))


def _plain(value: np.ndarray | np.floating) -> float | tuple[float, ...]:
    """Return a number or an array (N,) as plain numbers, as an effect's values hold them."""
    return tuple(map(float, np.atleast_1d(value))) if value.ndim else float(value)


def _own(vehicle: Vehicle, name: str) -> Any:
    """Return the vehicle's values of the effect `name`, or neutral ones."""
    return vehicle.effects.get(name, neutral(EFFECTS[name], vehicle))


def sweep_conditions(vehicle: Vehicle, sweep: Sweep) -> list[Condition]:
    """Return the conditions of `sweep`; the first is the unchanged `vehicle`."""
    first = Condition(sweep.name, sweep.sizes[0], f"{sweep.sizes[0]:g}", vehicle)
    rest = [
        Condition(sweep.name, size, f"{size:g}", *sweep.make(vehicle, size))
        for size in sweep.sizes[1:]
    ]
    return [first, *rest]


def _effect(
    name: str, field: str, scale: float | tuple[float, ...]
) -> Callable[..., tuple[Vehicle, SensorSet]]:
    def make(vehicle: Vehicle, size: float) -> tuple[Vehicle, SensorSet]:
        values = EFFECTS[name].values(**{field: _plain(np.asarray(scale) * size)})
        return with_effect(vehicle, name, values), PERFECT

    return make


def _heavier(vehicle: Vehicle, percent: float) -> tuple[Vehicle, SensorSet]:
    values = EFFECTS["mass_offset"].values(offset=percent / 100 * vehicle.mass)
    return with_effect(vehicle, "mass_offset", values), PERFECT


def _draggier(vehicle: Vehicle, factor: float) -> tuple[Vehicle, SensorSet]:
    for name in _drags(vehicle):
        own = vehicle.effects[name]
        more = _plain(factor * np.asarray(own.coefficient, float))
        vehicle = with_effect(vehicle, name, own._replace(coefficient=more))
    return vehicle, PERFECT


def _drags(vehicle: Vehicle) -> list[str]:
    """Return the kinds of drag that `vehicle` has."""
    return [
        name
        for name in DRAGS
        if name in vehicle.effects and np.any(vehicle.effects[name].coefficient)
    ]


def _drag_sweep(vehicle: Vehicle) -> Sweep:
    """Return the sweep of drag: multiples of the vehicle's own, or linear drag if it has none."""
    if _drags(vehicle):
        return Sweep("drag", "drag, times the vehicle's own", (1, 2, 4, 8, 16), _draggier)
    drag = _effect("linear_drag", "coefficient", (1.0, 1.0, 1.0))
    return Sweep("drag", "linear drag, each axis [1/s]", (0, 0.5, 1, 2, 4), drag)


def _sensing(
    model: str, scale: float, *names: str, **held: float
) -> Callable[..., tuple[Vehicle, SensorSet]]:
    """Return a function that sets parameters of a sensor model to `scale` times a size.

    The parameters `held` are the same at every size.
    """

    def make(vehicle: Vehicle, size: float) -> tuple[Vehicle, SensorSet]:
        return vehicle, sensor_set({model: dict.fromkeys(names, scale * size) | held})

    return make


def _estimating(vehicle: Vehicle, factor: float) -> tuple[Vehicle, SensorSet]:
    grown = {name: factor * size for name, size in STATE_UNIT.items()}
    return vehicle, sensor_set({"state_noise": {**grown, "correlation": 0.5}})


def sweeps(vehicle: Vehicle) -> list[Sweep]:
    """Return all sweeps, each starting from `vehicle`."""
    lag = 1e3 * _own(vehicle, "motor_lag").time_constant
    delay = 1e3 * _own(vehicle, "command_delay").delay
    heavier = 100 * _own(vehicle, "mass_offset").offset / vehicle.mass
    wind = float(np.linalg.norm(_own(vehicle, "constant_wind").velocity))

    def more(first: float, *others: float) -> tuple[float, ...]:
        # A vehicle at or beyond the last size gets larger ones.
        return (first, *([size for size in others if size > first] or (1.5 * first, 2 * first)))

    return [
        Sweep("motor lag", "rotor time constant [ms]", more(lag, 50, 80, 120, 180),
              _effect("motor_lag", "time_constant", 1e-3)),
        Sweep("latency", "command delay [ms]", more(delay, 50, 80, 120, 180),
              _effect("command_delay", "delay", 1e-3)),
        Sweep("mass", "mass above nominal [%]", more(heavier, 10, 20, 40, 60), _heavier),
        _drag_sweep(vehicle),
        Sweep("wind", "constant wind [m/s]", more(wind, 2, 4, 6, 8),
              _effect("constant_wind", "velocity", CONSTANT_WIND.parameters[0].direction)),
        Sweep("depth noise", "standard deviation of inverse depth [1/m]", (0, 0.01, 0.03, 0.1, 0.3),
              _sensing("stereo", 1, "noise", focal=1.0, baseline=1.0)),
        Sweep("gate-pose error", "standard deviation per axis [m]", (0, 0.05, 0.1, 0.2, 0.3),
              _sensing("gate_map", 1, "moved")),
        Sweep("age of the state", "age at the decision [ms]", (0, 20, 40, 60, 80, 100),
              _sensing("delay", 1e-3, "state")),
        Sweep("age of the image", "age at the decision [ms]", (0, 20, 40, 60, 80, 100),
              _sensing("delay", 1e-3, "image")),
        Sweep("age of both", "age at the decision [ms]", (0, 20, 40, 60, 80, 100),
              _sensing("delay", 1e-3, "state", "image")),
        Sweep("jittering age of both", "mean age at the decision [ms]", (0, 20, 40, 60, 80, 100),
              _sensing("delay", 1e-3, "state", "image", jitter=1.0)),
        Sweep("lost images", "share of the images [%]", (0, 10, 30, 50, 80),
              _sensing("frame_loss", 1e-2, "share")),
        Sweep("state-estimation noise", "times 3 cm, 0.1 m/s, 1 deg", (0, 1, 2, 4, 8), _estimating),
    ]  # fmt: skip
