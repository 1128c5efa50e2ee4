"""Fly policies under conditions: single effects at their usual size, and sweeps.

The neutral value of an effect changes nothing, such as a drag of 0. A sweep is a series of
conditions in which one disturbance grows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from eval.effects import EFFECTS
from eval.effects.interface import Effect, bound_value, neutral
from eval.effects.wind import CONSTANT_WIND
from eval.judging.statistics import Interval, PairedDifference, paired_success, wilson
from eval.sensors.sensors_file import PERFECT, SensorSet, sensor_set
from eval.vehicles.vehicle import Vehicle, with_effects
from eval.worlds.trial import TrialResult, TrialSpec
from suite.common.console import Console
from suite.experiments.study.cache import Workspace
from suite.experiments.study.judging import TrialRequest, fly_trials
from suite.experiments.study.options import select
from tracks.common.figures import with_unit

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
    sensors: SensorSet = PERFECT
    """Errors in what the policies see."""
    simulator: str = "mujoco"


@dataclass(frozen=True)
class Sweep:
    """A disturbance of growing size; the first size is that of the undisturbed vehicle."""

    name: str
    """Title of the chart."""
    axis: str
    """The quantity that grows, with its unit."""
    sizes: Sequence[float]
    """Values of the quantity in increasing order; the first is that of the undisturbed vehicle."""
    make: Callable[[float], Vehicle | SensorSet]
    """Function size -> what the condition of this size has: the vehicle, or the sensors."""


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
    size_text = with_unit(f"{parameter.name} {number}", parameter.unit)
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
    conditions = [Condition(sweep.name, first, f"{first:g}", vehicle)]
    for size in others:
        made = sweep.make(size)
        flown = (made, PERFECT) if isinstance(made, Vehicle) else (vehicle, made)
        conditions.append(Condition(sweep.name, size, f"{size:g}", *flown))
    return conditions


def sweeps(vehicle: Vehicle) -> list[Sweep]:
    """Return all sweeps, each starting from `vehicle`."""
    lag_ms = 1e3 * _values_of(vehicle, "motor_lag").time_constant
    delay_ms = 1e3 * _values_of(vehicle, "command_delay").delay
    added_percent = 100 * _values_of(vehicle, "mass_offset").offset / vehicle.mass
    wind_speed = float(np.linalg.norm(_values_of(vehicle, "constant_wind").velocity))
    drags = [n for n in DRAGS if n in vehicle.effects and np.any(vehicle.effects[n].coefficient)]

    def sizes(first: float, *others: float) -> tuple[float, ...]:
        """Return the sizes of a sweep that starts at the vehicle's own value `first`.

        They are `first` and those of `others` that are larger, or multiples of `first` if none is.
        """
        return (first, *([size for size in others if size > first] or (1.5 * first, 2 * first)))

    def effect(name: str, field: str, scale: float | tuple[float, ...]) -> Callable[..., Vehicle]:
        """Return a function that sets a parameter of an effect to `scale` times a size."""

        def make(size: float) -> Vehicle:
            values = EFFECTS[name].values(**{field: _plain(np.asarray(scale) * size)})
            return with_effects(vehicle, {name: values})

        return make

    def sensor(model: str, scale: float, *names: str, **fixed: float) -> Callable[..., SensorSet]:
        """Return a function that sets parameters of a sensor model to `scale` times a size.

        The parameters `fixed` are the same at every size.
        """
        return lambda size: sensor_set({model: dict.fromkeys(names, scale * size) | fixed})

    def add_mass(percent: float) -> Vehicle:
        values = EFFECTS["mass_offset"].values(offset=percent / 100 * vehicle.mass)
        return with_effects(vehicle, {"mass_offset": values})

    def scale_drag(factor: float) -> Vehicle:
        scaled = {}
        for name in drags:
            values = vehicle.effects[name]
            coefficient = _plain(factor * np.asarray(values.coefficient, float))
            scaled[name] = values._replace(coefficient=coefficient)
        return with_effects(vehicle, scaled)

    def add_state_noise(factor: float) -> SensorSet:
        errors = {name: factor * size for name, size in STATE_UNIT.items()}
        return sensor_set({"state_noise": {**errors, "correlation": 0.5}})

    if drags:
        drag = Sweep("drag", "drag, times the vehicle's own", (1, 2, 4, 8, 16), scale_drag)
    else:
        drag = Sweep("drag", "linear drag, each axis [1/s]", (0, 0.5, 1, 2, 4),
                     effect("linear_drag", "coefficient", (1.0, 1.0, 1.0)))  # fmt: skip
    return [
        Sweep("motor lag", "rotor time constant [ms]", sizes(lag_ms, 50, 80, 120, 180),
              effect("motor_lag", "time_constant", 1e-3)),
        Sweep("latency", "command delay [ms]", sizes(delay_ms, 50, 80, 120, 180),
              effect("command_delay", "delay", 1e-3)),
        Sweep("mass", "mass above nominal [%]", sizes(added_percent, 10, 20, 40, 60), add_mass),
        drag,
        Sweep("wind", "constant wind [m/s]", sizes(wind_speed, 2, 4, 6, 8),
              effect("constant_wind", "velocity", CONSTANT_WIND.parameters[0].direction)),
        Sweep("depth noise", "standard deviation of inverse depth [1/m]", (0, 0.01, 0.03, 0.1, 0.3),
              sensor("stereo", 1, "noise", focal=1.0, baseline=1.0)),
        Sweep("gate-pose error", "standard deviation per axis [m]", (0, 0.05, 0.1, 0.2, 0.3),
              sensor("gate_map", 1, "moved")),
        Sweep("age of the state", "age at the decision [ms]", (0, 20, 40, 60, 80, 100),
              sensor("delay", 1e-3, "state")),
        Sweep("age of the image", "age at the decision [ms]", (0, 20, 40, 60, 80, 100),
              sensor("delay", 1e-3, "image")),
        Sweep("age of both", "age at the decision [ms]", (0, 20, 40, 60, 80, 100),
              sensor("delay", 1e-3, "state", "image")),
        Sweep("jittering age of both", "mean age at the decision [ms]", (0, 20, 40, 60, 80, 100),
              sensor("delay", 1e-3, "state", "image", jitter=1.0)),
        Sweep("lost images", "share of the images [%]", (0, 10, 30, 50, 80),
              sensor("frame_loss", 1e-2, "share")),
        Sweep("state-estimation noise", "times 3 cm, 0.1 m/s, 1 deg", (0, 1, 2, 4, 8),
              add_state_noise),
    ]  # fmt: skip


class ConditionResult(NamedTuple):
    """A condition and the results of every policy under it, on the same trials."""

    condition: Condition
    """Vehicle, sensors and simulator of the flights."""
    results: Mapping[str, Sequence[TrialResult]]
    """Label of each policy -> results of its trials."""

    def success(self, policy: str) -> Interval:
        """Return the success rate over all tracks and levels."""
        return wilson(int(self.won(policy).sum()), len(self.results[policy]))

    def won(self, policy: str) -> np.ndarray:
        """Return whether each trial of a policy succeeded, (n,) bool."""
        return np.array([row.success for row in self.results[policy]])

    def median(self, policy: str, field: str) -> float:
        """Return the median of a field (such as `v_mean`) over the trials of a policy."""
        return float(np.median([getattr(row, field) for row in self.results[policy]]))

    def minus(self, base: ConditionResult, policy: str, other: str = "") -> PairedDifference:
        """Return the success rate of `policy` minus that of `other` (or the same) under `base`."""
        return paired_success(self.won(policy), base.won(other or policy))


SweepResults = dict[Sweep, list[ConditionResult]]
"""Sweep -> results under its conditions; the undisturbed condition is the first."""


def select_conditions(
    vehicle: Vehicle, only: Sequence[str]
) -> tuple[list[Condition], dict[Sweep, list[Condition]]]:
    """Return the conditions with one effect each, and the conditions of each sweep.

    With names in `only`, both parts have these effects and sweeps alone.

    Raises:
        ValueError: for an unknown name.
    """
    all_sweeps, singles = sweeps(vehicle), effect_conditions(vehicle)
    known = dict.fromkeys(entry.name for entry in (*all_sweeps, *singles))
    names = select(known, only, "effect or sweep")
    return (
        [condition for condition in singles if condition.name in names],
        {sweep: sweep_conditions(vehicle, sweep) for sweep in all_sweeps if sweep.name in names},
    )


def fly_conditions(
    conditions: Sequence[Condition],
    policies: Mapping[str, str],
    trials: Sequence[TrialSpec],
    workspace: Workspace,
    console: Console,
) -> list[ConditionResult]:
    """Return the results of every policy under every condition.

    `policies` maps labels to names or paths. Each policy flies all trials under every condition.
    """
    requests = {
        (number, name): TrialRequest(
            policy, condition.vehicle, trials, condition.sensors, condition.simulator
        )
        for name, policy in policies.items()
        for number, condition in enumerate(conditions)
    }
    rows = fly_trials(requests, workspace, console, "flying under every condition")
    return [
        ConditionResult(condition, {name: rows[number, name] for name in policies})
        for number, condition in enumerate(conditions)
    ]


def by_sweep(
    results: Iterable[ConditionResult], sweeps: Mapping[Sweep, Sequence[Condition]]
) -> SweepResults:
    """Return the results under the conditions of `sweeps`, which are in this order, by sweep."""
    remaining = iter(results)
    return {sweep: [next(remaining) for _ in points] for sweep, points in sweeps.items()}


def tested_numbers(entry: ConditionResult, base: ConditionResult) -> dict[str, Any]:
    """Return the results under one condition for JSON, over all trials and by track.

    `change` is the difference of the success rate to that under `base`, the undisturbed condition.
    """
    numbers: dict[str, Any] = {
        "name": entry.condition.name,
        "size": entry.condition.size,
        "words": entry.condition.size_text,
        "sensors": entry.condition.sensors,
        "effects": dict(entry.condition.vehicle.effects),
        "policies": {},
    }
    for name, rows in entry.results.items():
        tracks = dict.fromkeys(row.track for row in rows)
        numbers["policies"][name] = {
            "success": entry.success(name),
            "change": entry.minus(base, name),
            "tracks": {
                track: float(np.mean([row.success for row in rows if row.track == track]))
                for track in tracks
            },
            "v_max": entry.median(name, "v_max"),
            "v_mean": entry.median(name, "v_mean"),
        }
    return numbers
