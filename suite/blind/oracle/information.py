"""What the flights of a case can say about every parameter of the catalogue, without noise.

With g the whitened change of all logged channels for a unit of each parameter, the matrix
G = g^T g decides everything to first order: parameters theta away from the given vehicle raise the
expected log-likelihood ratio to theta^T G theta / 2, and what another effect leaves of it when it
is fitted in its place is a Schur complement of G.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from eval.effects import EFFECTS, all_values
from eval.effects.interface import at
from eval.quadrotor.plant import Motion
from eval.vehicles.vehicle import Vehicle
from suite.blind.oracle.stretches import (
    DELAY_STEP_S,
    Channels,
    Windows,
    cut,
    replay,
    state_columns,
    whitened,
    window_plant,
    without_start,
)
from suite.blind.sensors import Sensors
from suite.diagnose.plans.simulate import Recording

THRESHOLD = 12.5
"""Expected log-likelihood ratio at which an effect can just be detected: five sigma."""
REQUIRED = 2.0
"""A name that leaves less log-likelihood ratio than this (two sigma) on long stretches cannot be
told from the truth and must be among the alternatives."""
ALLOWED = THRESHOLD
"""A name that leaves less than this on short stretches may be among them, any other may not."""
MOSTLY = 0.25
"""A name may stand for another only where it leaves less than this share of what that explains."""
GUST_DRAWS = 24
"""Simulated draws of random wind."""


class Column(NamedTuple):
    """One component of one parameter."""

    effect: str
    parameter: str
    component: int
    """0 for plain numbers."""


@dataclass(frozen=True)
class Information:
    """G of a case's flights under one set of sensors."""

    columns: tuple[Column, ...]
    matrix: np.ndarray
    """(P, P), in the order of `columns`, per unit of each parameter."""

    def rows_of(self, effect: str) -> list[int]:
        """Return the numbers of the columns of `effect`."""
        return [i for i, column in enumerate(self.columns) if column.effect == effect]


def columns_of(has_voltage: bool) -> tuple[Column, ...]:
    """Return every component that flights can tell, but for the random wind."""
    found = []
    for effect in EFFECTS.values():
        for parameter in effect.parameters:
            name = parameter.name
            # The voltage decides by which of its two parameters a battery sags.
            sags = effect.name == "battery_sag" and (name == "per_volt") != has_voltage
            if effect.name == "gusts" or not parameter.fitted or sags:
                continue
            for component in range(parameter.size or 1):
                if component not in parameter.unseen:
                    found.append(Column(effect.name, name, component))
    return tuple(found)


def information(
    nominal: Vehicle,
    recordings: Sequence[Recording],
    sensors: Sensors,
    windows: Windows | None = None,
) -> Information:
    """Return what `recordings` say about the catalogue, measured from the `nominal` vehicle."""
    windows = windows or cut(recordings)
    columns, moved = signatures(nominal, windows, sensors)
    flat = moved.reshape(len(columns), -1)
    return Information(columns, flat @ flat.T)


def signatures(
    nominal: Vehicle, windows: Windows, sensors: Sensors
) -> tuple[tuple[Column, ...], np.ndarray]:
    """Return the columns and (P, W, D) what a unit of each does to the logged channels."""
    has_voltage = bool(sensors.voltage)
    columns = columns_of(has_voltage)
    basis, base = start_of(nominal, windows, sensors)
    flown = [c for c in columns if EFFECTS[c.effect].log is None]
    steps = np.array([_step_of(column) for column in flown])
    plant = window_plant(nominal, _changed(nominal, flown, steps))
    motion = Motion(*(np.broadcast_to(f, (len(flown), *f.shape)) for f in windows.motion))
    channels = replay(windows, plant, motion, has_voltage=has_voltage)
    moved = dict(zip(flown, whitened(sensors, channels, base) / steps[:, None, None], strict=True))
    for column in columns:
        if column not in moved:
            moved[column] = whitened(sensors, _faulty(column, base), base) / FAULT_STEP
    stacked = np.stack([moved[column] for column in columns])
    return columns, without_start(basis, stacked)


def start_of(nominal: Vehicle, windows: Windows, sensors: Sensors) -> tuple[np.ndarray, Channels]:
    """Return the basis of what an unknown start explains, and the stretches of `nominal`."""
    plant = window_plant(nominal)
    base = replay(windows, plant, has_voltage=bool(sensors.voltage))
    return state_columns(windows, plant, sensors, base), base


def gust_strength(
    nominal: Vehicle,
    windows: Windows,
    sensors: Sensors,
    length_m: float,
    rng: np.random.Generator,
) -> float:
    """Return the intensity [m/s] of random wind at which the log-likelihood ratio is `THRESHOLD`.

    The wind adds a covariance to the noise; with lambda its whitened eigenvalues for a unit of
    intensity, a stretch adds (s^2 lambda - log(1 + s^2 lambda)) / 2.
    """
    basis, base = start_of(nominal, windows, sensors)
    effects = {**nominal.effects, "gusts": EFFECTS["gusts"].values(1.0, length_m)}
    plant = window_plant(nominal, effects)
    count = len(windows.start_s)
    draws = rng.standard_normal((len(windows.command.thrust) + 1, GUST_DRAWS, count, 3))
    channels = replay(windows, plant, has_voltage=bool(sensors.voltage), draws=draws)
    moved = without_start(basis, whitened(sensors, channels, base))
    gram = np.einsum("kwd,lwd->wkl", moved, moved) / GUST_DRAWS
    eigenvalues = np.maximum(np.linalg.eigvalsh(gram), 0.0)

    def ratio(intensity: float) -> float:
        raised = intensity**2 * eigenvalues
        return float(0.5 * (raised - np.log1p(raised)).sum())

    low, high = 1e-4, 100.0
    if ratio(high) < THRESHOLD:
        return float("inf")
    for _ in range(60):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if ratio(middle) < THRESHOLD else (low, middle)
    return float(high)


def detectable(info: Information, effect: str, direction: np.ndarray) -> float:
    """Return how often `direction` (in the columns of `effect`) can just be detected.

    Infinite where these flights do not show it.
    """
    rows = info.rows_of(effect)
    ratio = 0.5 * direction @ info.matrix[np.ix_(rows, rows)] @ direction
    return float(np.sqrt(THRESHOLD / ratio)) if ratio > 1e-12 else float("inf")


def left_over(
    info: Information,
    truth: Mapping[str, np.ndarray],
    instead_of: str,
    other: str,
    nominal: Vehicle,
    one: int | None = None,
) -> float:
    """Return the log-likelihood ratio that is left where `other` is fitted for `instead_of`.

    Args:
        info: of the case's flights.
        truth: change of each true effect's columns from the given vehicle, by name.
        instead_of: the true effect that is left out; the other true ones are fitted too.
        other: the effect that takes its place, within its physical bounds.
        nominal: the given vehicle.
        one: use only this one of the columns of `other`.
    """
    from scipy.optimize import lsq_linear

    kept = [row for name in truth if name != instead_of for row in info.rows_of(name)]
    mine, theirs = info.rows_of(instead_of), info.rows_of(other)
    if one is not None:
        theirs = theirs[one : one + 1]
    used = [*mine, *theirs, *kept]
    matrix = info.matrix[np.ix_(used, used)]
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    matrix = matrix / np.outer(scale, scale)
    values, vectors = np.linalg.eigh(matrix)
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    target = root[:, : len(mine)] @ (truth[instead_of] * scale[: len(mine)])
    bounds = [_room(info.columns[row], nominal) for row in theirs]
    free = [(-np.inf, np.inf)] * len(kept)
    low, high = np.array([*bounds, *free]).T
    rest = scale[len(mine) :]
    fitted = lsq_linear(root[:, len(mine) :], target, (low * rest - 1e-12, high * rest + 1e-12))
    return float(fitted.cost)


def alternatives(
    info: Information, truth: Mapping[str, np.ndarray], nominal: Vehicle, has_acc: bool
) -> dict[str, dict[str, float]]:
    """Return for each true effect the names that may stand for it, with what they leave over."""
    found: dict[str, dict[str, float]] = {}
    for name in truth:
        rows = info.rows_of(name)
        whole = 0.5 * truth[name] @ info.matrix[np.ix_(rows, rows)] @ truth[name]
        found[name] = {}
        for other in EFFECTS:
            silent = other == "accelerometer_bias" and not has_acc
            if other in truth or other == "gusts" or silent:
                continue
            # All four rotors together imitate a thrust scale; a weak motor is one of them.
            single = range(4) if other == "weak_motor" else (None,)
            rest = min(left_over(info, truth, name, other, nominal, one) for one in single)
            if rest < min(ALLOWED, MOSTLY * whole):
                found[name][other] = rest
    return found


FAULT_STEP = 1e-4
"""By which a fault of the log is changed, in its own unit."""


def _step_of(column: Column) -> float:
    if column.effect in ("command_delay", "motor_lag"):
        return DELAY_STEP_S
    effect = EFFECTS[column.effect]
    parameter = next(p for p in effect.parameters if p.name == column.parameter)
    return 0.1 * parameter.typical[0]


def _changed(nominal: Vehicle, columns: Sequence[Column], steps: np.ndarray) -> dict[str, Any]:
    """Return every effect's values with leading axes (P, 1), each changed in its own columns."""
    changed = {}
    for name, values in all_values(nominal).items():
        if name == "gusts":
            continue
        fields = {}
        for key, value in values._asdict().items():
            batch = np.tile(value, (len(columns), 1, *(1,) * value.ndim))
            for row, column in enumerate(columns):
                if (column.effect, column.parameter) == (name, key):
                    index = (row, 0, column.component) if value.ndim else (row, 0)
                    batch[index] += steps[row]
            fields[key] = batch
        changed[name] = type(values)(**fields)
    return changed


def _faulty(column: Column, base: Channels) -> Channels:
    """Return `base` with a fault of the log of size `FAULT_STEP`."""
    unit = FAULT_STEP * np.eye(3)[column.component]
    if column.effect == "gyro_bias":
        return base._replace(rate_b=base.rate_b + unit)
    if column.effect == "accelerometer_bias":
        return base._replace(acc_b=base.acc_b + unit)
    # Along the true motion: poses of a moment earlier.
    from eval.effects.interface import GRAVITY
    from tracks.geometry.rotation import exp_rot, to_world

    acc_w = to_world(base.rot_w, base.acc_b) - np.array([0.0, 0.0, GRAVITY])
    acc_w[0] = acc_w[1]
    return base._replace(
        pos_w=base.pos_w - FAULT_STEP * base.vel_w,
        vel_w=base.vel_w - FAULT_STEP * acc_w,
        rot_w=np.matmul(base.rot_w, exp_rot(-FAULT_STEP * base.rate_b)),
    )


def _room(column: Column, nominal: Vehicle) -> tuple[float, float]:
    """Return how far down and up a component may go from its value in the given vehicle."""
    effect = EFFECTS[column.effect]
    parameter = next(p for p in effect.parameters if p.name == column.parameter)
    given = getattr(all_values(nominal)[column.effect], column.parameter)
    value = float(given[column.component]) if given.ndim else float(given)
    return at(parameter.low, nominal) - value, at(parameter.high, nominal) - value
