"""The conditions of the page `robustness`: single effects at their usual size, and sweeps.

An effect is one physical cause of a mismatch, such as drag. Its neutral value is the one that
changes nothing, such as a drag of 0. A sweep is a series of conditions in which one disturbance
grows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from eval.effects import EFFECTS
from eval.effects.interface import Effect, bound_value, neutral
from eval.effects.wind import CONSTANT_WIND
from eval.sensors.sensors_file import PERFECT, SensorSet, sensor_set
from eval.vehicles.vehicle import Vehicle, with_effects

STATE_UNIT = {"position": 0.03, "velocity": 0.1, "attitude": math.radians(1.0)}
"""Errors of the estimated state at size 1 of its sweep: position [m], velocity [m/s], attitude
[rad]."""
DRAGS = ("linear_drag", "quadratic_drag", "rotor_drag")
"""Effects whose coefficients grow in the sweep of drag, if the vehicle has them."""


@dataclass(frozen=True)
class Condition:
    """A vehicle, sensors and a simulator with which policies fly; usually one of them differs."""

    name: str
    """Name of the effect or the sweep."""
    size: float
    """Size of the disturbance, in the unit of the sweep or, in its usual direction, the effect."""
    size_text: str
    """Size of the disturbance as text, with its unit."""
    vehicle: Vehicle
    """Vehicle that flies."""
    sensors: SensorSet = PERFECT
    """Errors in what the policies see."""
    simulator: str = "mujoco"
    """Name of the simulator."""


@dataclass(frozen=True)
class Sweep:
    """A disturbance of growing size; the first size is that of the undisturbed vehicle."""

    name: str
    """Title of the chart."""
    axis: str
    """The quantity that grows, with its unit."""
    sizes: Sequence[float]
    """Values of the quantity in increasing order; the first is that of the undisturbed vehicle."""
    make: Callable[[Vehicle, float], tuple[Vehicle, SensorSet]]
    """Function (undisturbed vehicle, size) -> vehicle and sensors with this size."""


def effect_conditions(vehicle: Vehicle) -> list[Condition]:
    """Return a condition for each effect that changes a flight, at the upper end of its usual size.

    An effect that has two usual signs gives two conditions. If the vehicle already has a larger
    value, it keeps that. The size is limited to physical values: a vehicle of 27 g cannot lose
    0.2 kg. Only the first parameter of an effect changes.
    """
    conditions = []
    for effect in EFFECTS.values():
        if effect.in_flight:
            signs = effect.parameters[0].signs
            conditions += [_effect_condition(vehicle, effect, sign) for sign in signs]
    return conditions


def _effect_condition(vehicle: Vehicle, effect: Effect, sign: int) -> Condition:
    """Return `vehicle` with one effect, up (+1) or down (-1) from its neutral value."""
    parameter = effect.parameters[0]
    values = _values_of(vehicle, effect.name)
    # `typical` is the usual range of the difference from neutral. With `whole` it is the range of
    # the value itself, which then counts from 0.
    size = parameter.typical[1]
    zero = np.asarray(getattr(neutral(effect, vehicle), parameter.name), float)
    zero = np.zeros_like(zero) if parameter.whole else zero
    # The usual size in the usual direction, within the physical bounds; a larger value is kept.
    direction = np.asarray(parameter.direction) if parameter.direction else np.ones(zero.shape)
    new = zero + sign * size * direction
    new = np.clip(new, bound_value(parameter.low, vehicle), bound_value(parameter.high, vehicle))
    given = np.asarray(getattr(values, parameter.name), float)
    new = np.where(np.abs(given - zero) > np.abs(new - zero), given, new)
    flown = np.vdot(new - zero, direction) / np.vdot(direction, direction)
    value = _plain(new)
    number = "(" + ", ".join(f"{v:.3g}" for v in new) + ")" if new.ndim else f"{value:.3g}"
    unit = "" if parameter.unit == "1" else parameter.unit
    size_text = f"{parameter.name} {number} {unit}".strip()
    changed = with_effects(vehicle, {effect.name: values._replace(**{parameter.name: value})})
    return Condition(effect.name, float(f"{flown:.6g}"), size_text, changed)


def _plain(value: np.ndarray | np.floating) -> float | tuple[float, ...]:
    """Return a number or an array (N,) as plain Python numbers, for an effect's values."""
    return tuple(map(float, np.atleast_1d(value))) if value.ndim else float(value)


def _values_of(vehicle: Vehicle, name: str) -> Any:
    """Return the vehicle's values of the effect `name`, or neutral ones."""
    return vehicle.effects.get(name, neutral(EFFECTS[name], vehicle))


def sweep_conditions(vehicle: Vehicle, sweep: Sweep) -> list[Condition]:
    """Return the conditions of `sweep`; the first is the unchanged `vehicle`."""
    first, *others = sweep.sizes
    return [
        Condition(sweep.name, first, f"{first:g}", vehicle),
        *(Condition(sweep.name, size, f"{size:g}", *sweep.make(vehicle, size)) for size in others),
    ]


def _set_effect(
    name: str, field: str, scale: float | tuple[float, ...]
) -> Callable[..., tuple[Vehicle, SensorSet]]:
    """Return a function that sets a parameter of an effect to `scale` times a size."""

    def make(vehicle: Vehicle, size: float) -> tuple[Vehicle, SensorSet]:
        """Return `vehicle` with the effect at `size`, and perfect sensors."""
        values = EFFECTS[name].values(**{field: _plain(np.asarray(scale) * size)})
        return with_effects(vehicle, {name: values}), PERFECT

    return make


def _add_mass(vehicle: Vehicle, percent: float) -> tuple[Vehicle, SensorSet]:
    """Return `vehicle` with its mass above the nominal one by `percent`, and perfect sensors."""
    values = EFFECTS["mass_offset"].values(offset=percent / 100 * vehicle.mass)
    return with_effects(vehicle, {"mass_offset": values}), PERFECT


def _scale_drag(vehicle: Vehicle, factor: float) -> tuple[Vehicle, SensorSet]:
    """Return `vehicle` with all its drag coefficients times `factor`, and perfect sensors."""
    for name in _drags(vehicle):
        values = vehicle.effects[name]
        coefficient = _plain(factor * np.asarray(values.coefficient, float))
        vehicle = with_effects(vehicle, {name: values._replace(coefficient=coefficient)})
    return vehicle, PERFECT


def _drags(vehicle: Vehicle) -> list[str]:
    """Return the names of the drag effects that `vehicle` has."""
    return [
        name
        for name in DRAGS
        if name in vehicle.effects and np.any(vehicle.effects[name].coefficient)
    ]


def _drag_sweep(vehicle: Vehicle) -> Sweep:
    """Return the sweep of drag: multiples of the vehicle's drag, or linear drag if it has none."""
    if _drags(vehicle):
        return Sweep("drag", "drag, times the vehicle's own", (1, 2, 4, 8, 16), _scale_drag)
    drag = _set_effect("linear_drag", "coefficient", (1.0, 1.0, 1.0))
    return Sweep("drag", "linear drag, each axis [1/s]", (0, 0.5, 1, 2, 4), drag)


def _set_sensor(
    model: str, scale: float, *names: str, **fixed: float
) -> Callable[..., tuple[Vehicle, SensorSet]]:
    """Return a function that sets parameters of a sensor model to `scale` times a size.

    The parameters `fixed` are the same at every size.
    """

    def make(vehicle: Vehicle, size: float) -> tuple[Vehicle, SensorSet]:
        return vehicle, sensor_set({model: dict.fromkeys(names, scale * size) | fixed})

    return make


def _add_state_noise(vehicle: Vehicle, factor: float) -> tuple[Vehicle, SensorSet]:
    """Return `vehicle`, and sensors with `factor` times the errors of STATE_UNIT."""
    errors = {name: factor * size for name, size in STATE_UNIT.items()}
    return vehicle, sensor_set({"state_noise": {**errors, "correlation": 0.5}})


def sweeps(vehicle: Vehicle) -> list[Sweep]:
    """Return all sweeps, each starting from `vehicle`."""
    lag_ms = 1e3 * _values_of(vehicle, "motor_lag").time_constant
    delay_ms = 1e3 * _values_of(vehicle, "command_delay").delay
    added_percent = 100 * _values_of(vehicle, "mass_offset").offset / vehicle.mass
    wind_speed = float(np.linalg.norm(_values_of(vehicle, "constant_wind").velocity))

    def sizes(first: float, *others: float) -> tuple[float, ...]:
        """Return the sizes of a sweep that starts at the vehicle's own value `first`.

        They are `first` and those of `others` that are larger, or multiples of `first` if none is.
        """
        return (first, *([size for size in others if size > first] or (1.5 * first, 2 * first)))

    return [
        Sweep("motor lag", "rotor time constant [ms]", sizes(lag_ms, 50, 80, 120, 180),
              _set_effect("motor_lag", "time_constant", 1e-3)),
        Sweep("latency", "command delay [ms]", sizes(delay_ms, 50, 80, 120, 180),
              _set_effect("command_delay", "delay", 1e-3)),
        Sweep("mass", "mass above nominal [%]", sizes(added_percent, 10, 20, 40, 60), _add_mass),
        _drag_sweep(vehicle),
        Sweep("wind", "constant wind [m/s]", sizes(wind_speed, 2, 4, 6, 8),
              _set_effect("constant_wind", "velocity", CONSTANT_WIND.parameters[0].direction)),
        Sweep("depth noise", "standard deviation of inverse depth [1/m]", (0, 0.01, 0.03, 0.1, 0.3),
              _set_sensor("stereo", 1, "noise", focal=1.0, baseline=1.0)),
        Sweep("gate-pose error", "standard deviation per axis [m]", (0, 0.05, 0.1, 0.2, 0.3),
              _set_sensor("gate_map", 1, "moved")),
        Sweep("age of the state", "age at the decision [ms]", (0, 20, 40, 60, 80, 100),
              _set_sensor("delay", 1e-3, "state")),
        Sweep("age of the image", "age at the decision [ms]", (0, 20, 40, 60, 80, 100),
              _set_sensor("delay", 1e-3, "image")),
        Sweep("age of both", "age at the decision [ms]", (0, 20, 40, 60, 80, 100),
              _set_sensor("delay", 1e-3, "state", "image")),
        Sweep("jittering age of both", "mean age at the decision [ms]", (0, 20, 40, 60, 80, 100),
              _set_sensor("delay", 1e-3, "state", "image", jitter=1.0)),
        Sweep("lost images", "share of the images [%]", (0, 10, 30, 50, 80),
              _set_sensor("frame_loss", 1e-2, "share")),
        Sweep("state-estimation noise", "times 3 cm, 0.1 m/s, 1 deg", (0, 1, 2, 4, 8),
              _add_state_noise),
    ]  # fmt: skip
