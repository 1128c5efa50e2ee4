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

from eval.effects import EFFECTS, all_values, nameable_effects
from eval.effects.interface import GRAVITY, Parameter, Sample, Values, as_arrays, at, neutral
from eval.effects.log_faults import lateness, measured
from eval.vehicles.vehicle import Vehicle
from suite.blind.oracle.stretches import (
    DELAY_STEP_S,
    Channels,
    Stretches,
    replay,
    state_columns,
    stretch_plant,
    whitened,
    without_start,
)
from suite.diagnose.plans.simulate import Sensors
from tracks.geometry.rotation import exp_rot, to_world

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
FAULT_STEP = 1e-4
"""By which a fault of the log is changed, in its own unit."""


class Column(NamedTuple):
    """One component of one parameter."""

    effect: str
    parameter: str
    component: int
    """0 for plain numbers."""

    @property
    def spec(self) -> Parameter:
        """The parameter in the catalogue."""
        found = EFFECTS[self.effect].parameters
        return next(parameter for parameter in found if parameter.name == self.parameter)

    def value(self, values: Values) -> float:
        """Return the component in `values` of its effect."""
        return float(np.ravel(getattr(values, self.parameter))[self.component])

    def room(self, nominal: Vehicle) -> tuple[float, float]:
        """Return how far down and up it may go from its value in the given vehicle."""
        given = self.value(all_values(nominal)[self.effect])
        return at(self.spec.low, nominal) - given, at(self.spec.high, nominal) - given


@dataclass(frozen=True)
class Information:
    """G of a case's flights under one set of sensors."""

    columns: tuple[Column, ...]
    matrix: np.ndarray
    """(P, P), in the order of `columns`, per unit of each parameter."""

    def rows_of(self, effect: str) -> list[int]:
        """Return the numbers of the columns of `effect`."""
        return [i for i, column in enumerate(self.columns) if column.effect == effect]

    def block(self, effect: str) -> np.ndarray:
        """Return the part of the matrix that belongs to `effect`."""
        rows = self.rows_of(effect)
        return self.matrix[np.ix_(rows, rows)]


def columns_of(has_voltage: bool, names: Sequence[str] | None = None) -> tuple[Column, ...]:
    """Return every component that flights can tell, of `names` or of all, but for random wind."""
    return tuple(
        Column(name, parameter.name, component)
        for name, effect in EFFECTS.items()
        if not effect.random and (names is None or name in names)
        for parameter, component in effect.components(has_voltage)
    )


def information(
    nominal: Vehicle, stretches: Stretches, sensors: Sensors, names: Sequence[str] | None = None
) -> Information:
    """Return what stretches say about effects (all, or `names`), from the `nominal` vehicle on."""
    columns, moved = signatures(nominal, stretches, sensors, names)
    flat = moved.reshape(len(columns), -1)
    return Information(columns, flat @ flat.T)


def signatures(
    nominal: Vehicle, stretches: Stretches, sensors: Sensors, names: Sequence[str] | None = None
) -> tuple[tuple[Column, ...], np.ndarray]:
    """Return the columns and (P, W, D) what a unit of each does to the logged channels."""
    has_voltage = bool(sensors.voltage)
    columns = columns_of(has_voltage, names)
    basis, base = start_of(nominal, stretches, sensors)
    flown = [c for c in columns if EFFECTS[c.effect].in_flight]
    moved = {
        column: whitened(sensors, _faulty(column, base, nominal), base) / FAULT_STEP
        for column in columns
        if column not in flown
    }
    if flown:
        # Times act by whole physics steps.
        steps = np.array(
            [DELAY_STEP_S if c.spec.unit == "s" else 0.1 * c.spec.typical[0] for c in flown]
        )
        plant = stretch_plant(nominal, _changed(nominal, flown, steps))
        apart = whitened(sensors, replay(stretches, plant, has_voltage=has_voltage), base)
        moved |= dict(zip(flown, apart / steps[:, None, None], strict=True))
    return columns, without_start(basis, np.stack([moved[column] for column in columns]))


def start_of(
    nominal: Vehicle, stretches: Stretches, sensors: Sensors
) -> tuple[np.ndarray, Channels]:
    """Return the basis of what an unknown start explains, and the stretches of `nominal`."""
    plant = stretch_plant(nominal)
    base = replay(stretches, plant, has_voltage=bool(sensors.voltage))
    return state_columns(stretches, plant, sensors, base), base


def gust_strength(
    nominal: Vehicle,
    stretches: Stretches,
    sensors: Sensors,
    name: str,
    rng: np.random.Generator,
) -> float:
    """Return the size of random wind `name` at which the log-likelihood ratio is `THRESHOLD`.

    The size s is its first parameter, to which the wind is proportional; the others are neutral.
    It adds a covariance to the noise; with lambda its whitened eigenvalues for s = 1, a stretch
    adds (s^2 lambda - log(1 + s^2 lambda)) / 2.
    """
    basis, base = start_of(nominal, stretches, sensors)
    wind = EFFECTS[name].values(1.0, *neutral(EFFECTS[name], nominal)[1:])
    plant = stretch_plant(nominal, {**nominal.effects, name: wind})
    count = len(stretches.start_s)
    draws = rng.standard_normal((len(stretches.command) + 1, GUST_DRAWS, count, 3))
    channels = replay(stretches, plant, has_voltage=bool(sensors.voltage), draws=draws)
    moved = without_start(basis, whitened(sensors, channels, base))
    gram = np.einsum("kwd,lwd->wkl", moved, moved) / GUST_DRAWS
    eigenvalues = np.maximum(np.linalg.eigvalsh(gram), 0.0)

    def ratio(intensity: float) -> float:
        raised = intensity**2 * eigenvalues
        return float(0.5 * (raised - np.log1p(raised)).sum())

    low, high = 1e-4, 100.0
    for _ in range(60):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if ratio(middle) < THRESHOLD else (low, middle)
    return float(high) if ratio(high) >= THRESHOLD else float("inf")


def log_ratio(matrix: np.ndarray, change: np.ndarray) -> float:
    """Return the expected log-likelihood ratio of a `change` (P,) under information (P, P)."""
    return float(0.5 * change @ matrix @ change)


def detectable(matrix: np.ndarray, direction: np.ndarray) -> float:
    """Return how often `direction` (P,) can just be detected; infinite where it does not show."""
    ratio = log_ratio(matrix, direction)
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
        other: takes its place, within its physical bounds; only its column `one` if that is given.
        nominal: the given vehicle.
        one: number of a column.
    """
    from scipy.optimize import lsq_linear

    kept = [row for name in truth if name != instead_of for row in info.rows_of(name)]
    mine, theirs = info.rows_of(instead_of), info.rows_of(other)
    theirs = theirs if one is None else [theirs[one]]
    used, count = [*mine, *theirs, *kept], len(mine)
    matrix = info.matrix[np.ix_(used, used)]
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    target = root[:, :count] @ (truth[instead_of] * scale[:count])
    free = [(-np.inf, np.inf)] * len(kept)
    room = np.array([*(info.columns[row].room(nominal) for row in theirs), *free]).T
    low, high = room * scale[count:] + np.array([[-1e-12], [1e-12]])
    return float(lsq_linear(root[:, count:], target, (low, high)).cost)


def alternatives(
    info: Information, truth: Mapping[str, np.ndarray], nominal: Vehicle, has_acc: bool
) -> dict[str, dict[str, float]]:
    """Return for each true effect the names that may stand for it, with what they leave over."""
    found: dict[str, dict[str, float]] = {name: {} for name in truth}
    for other in nameable_effects():
        effect = EFFECTS[other]
        if other in truth or effect.random or ("acc_b" in effect.needs and not has_acc):
            continue
        # All four rotors together imitate a thrust scale; a weak motor is one of them.
        rows = info.rows_of(other)
        alone = any(info.columns[row].spec.one_at_a_time for row in rows)
        single = range(len(rows)) if alone else (None,)
        for name in truth:
            whole = log_ratio(info.block(name), truth[name])
            rest = min(left_over(info, truth, name, other, nominal, one) for one in single)
            if rest < min(ALLOWED, MOSTLY * whole):
                found[name][other] = rest
    return found


def _changed(nominal: Vehicle, columns: Sequence[Column], steps: np.ndarray) -> dict[str, Any]:
    """Return every effect's values with leading axes (P, 1), each changed in its own columns."""
    changed = {
        name: type(values)(*(np.tile(v, (len(columns), 1, *(1,) * v.ndim)) for v in values))
        for name, values in all_values(nominal).items()
        if EFFECTS[name].by_state
    }
    for row, column in enumerate(columns):
        field = getattr(changed[column.effect], column.parameter)
        field.reshape(len(columns), -1)[row, column.component] += steps[row]
    return changed


def _faulty(column: Column, base: Channels, nominal: Vehicle) -> Channels:
    """Return `base` with a fault of the log of size `FAULT_STEP`."""
    none = as_arrays(neutral(EFFECTS[column.effect], nominal))
    field = getattr(none, column.parameter)
    step = FAULT_STEP * np.eye(max(field.size, 1))[column.component].reshape(field.shape)
    fault = {column.effect: none._replace(**{column.parameter: field + step})}
    sample = Sample(*base[: len(Sample._fields)])
    if EFFECTS[column.effect].late:
        late = lateness(fault)  # along the true motion: poses of a moment earlier
        acc_w = to_world(base.rot_w, base.acc_b) - np.array([0.0, 0.0, GRAVITY])
        acc_w[0] = acc_w[1]
        sample = sample._replace(
            pos_w=base.pos_w - late * base.vel_w,
            vel_w=base.vel_w - late * acc_w,
            rot_w=np.matmul(base.rot_w, exp_rot(-late * base.rate_b)),
        )
    return Channels(*measured(fault, sample), base.rotor_speed)
