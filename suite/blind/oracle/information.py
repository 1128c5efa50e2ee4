"""The Fisher information of a case's flights about all parameters of the catalogue.

g is the whitened Jacobian of all logged channels, and G = g^T g. To first order a parameter change
theta from the given vehicle has the expected log-likelihood ratio theta^T G theta / 2. The part of
it that remains after a fit of another effect is a Schur complement of G.

g is the linearisation of the diagnosis's rollouts at the given vehicle, along flights without
noise. The oracle shares errors of this linearisation; the simulators of the cases are independent
of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import lsq_linear, root_scalar

from eval.effects import EFFECTS, all_values, nameable_effects
from eval.effects.interface import Parameter, Values, bound_value, neutral
from eval.flights.simulate import Sensors, fly, log_of
from eval.flights.trajectory import Trajectory
from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle, with_effects
from suite.diagnose.data.colour import Noise
from suite.diagnose.data.windows import LENGTH_S, cut
from suite.diagnose.estimate.block import Block
from suite.diagnose.estimate.parameters import make_space
from suite.diagnose.evidence.rollouts import RolloutModel, rollout_evidence, start_estimate
from suite.diagnose.thresholds import THRESHOLDS

SHORT_S, LONG_S = 0.5, LENGTH_S
"""Lengths of rollouts [s]; an error of force grows with the square of time."""
THRESHOLD = 12.5
"""Expected log-likelihood ratio of a just detectable effect: five sigma."""
REQUIRED = 0.125
"""A name with a smaller remaining log-likelihood ratio in long rollouts (half a sigma; two sigma in
rollouts of twice their length) must be among the alternatives."""
ALLOWED = THRESHOLD
"""Only a name with a smaller remaining ratio in short rollouts may be among the alternatives."""
MOSTLY = 0.25
"""A name can replace another only if its remaining ratio is below this share of the explained
one."""
GUST_DRAWS = 24
"""Number of flights with random wind on each trajectory."""
LIMITS = replace(THRESHOLDS, most_windows=100_000)
"""Every stretch counts."""


class Column(NamedTuple):
    """One component of one parameter."""

    effect: str
    parameter: str
    component: int
    """Index of the component; 0 for a plain number."""

    @property
    def spec(self) -> Parameter:
        """The parameter in the catalogue."""
        found = EFFECTS[self.effect].parameters
        return next(parameter for parameter in found if parameter.name == self.parameter)

    def value(self, values: Values) -> float:
        """Return the component in `values` of its effect."""
        return float(np.ravel(getattr(values, self.parameter))[self.component])

    def room(self, nominal: Vehicle) -> tuple[float, float]:
        """Return the allowed change down and up from its value in the given vehicle."""
        given = self.value(all_values(nominal)[self.effect])
        return bound_value(self.spec.low, nominal) - given, bound_value(
            self.spec.high, nominal
        ) - given


@dataclass(frozen=True)
class Information:
    """G of a case's flights under one set of sensors."""

    columns: tuple[Column, ...]
    matrix: np.ndarray
    """(P, P), in the order of `columns`, per unit of each parameter."""

    def rows_of(self, effect: str) -> list[int]:
        """Return the indices of the columns of `effect`."""
        return [i for i, column in enumerate(self.columns) if column.effect == effect]

    def block(self, effect: str) -> np.ndarray:
        """Return the part of the matrix that belongs to `effect`."""
        rows = self.rows_of(effect)
        return self.matrix[np.ix_(rows, rows)]


def columns_of(has_voltage: bool, names: Sequence[str] | None = None) -> tuple[Column, ...]:
    """Return all identifiable components of `names`, or of all effects, without random wind."""
    return tuple(
        Column(name, parameter.name, component)
        for name, effect in EFFECTS.items()
        if effect.by_state and (names is None or name in names)
        for parameter, component in effect.components(has_voltage)
    )


def information(
    nominal: Vehicle,
    logs: Sequence[FlightLog],
    sensors: Sensors,
    names: Sequence[str] | None = None,
    horizon_s: float = SHORT_S,
) -> Information:
    """Return the information of flights about effects (all, or `names`) at the `nominal` vehicle.

    Arguments are those of `linearised`.
    """
    columns = columns_of(bool(sensors.voltage), names)
    matrix, _ = linearised(nominal, logs, sensors, columns, horizon_s).equations.sums()
    return Information(columns, matrix)


def linearised(
    nominal: Vehicle,
    logs: Sequence[FlightLog],
    sensors: Sensors,
    columns: Sequence[Column],
    horizon_s: float = SHORT_S,
) -> Block:
    """Return whitened rollouts of `nominal` along logs, with unknown starts projected out.

    Args:
        nominal: the given vehicle.
        logs: without noise.
        sensors: their noise; rows at another rate have the same weight per second.
        columns: parameters of the Jacobian.
        horizon_s: length of a rollout, and distance of their starts [s].
    """
    space = make_space(nominal)
    place = [Column(entry.effect, entry.parameter, entry.component or 0) for entry in space.entries]
    along = [place.index(column) for column in columns]
    stepped = logs[0].integrator or "continuous"
    model = RolloutModel(nominal, space, False, bool(sensors.voltage), stepped)
    windows, _ = cut(logs, nominal, False, horizon_s, LIMITS, stepped)
    assert windows is not None, "flights of a case have a whole second"
    row_s = np.asarray(windows.row_s)
    windows = windows._replace(valid=windows.valid & (row_s < horizon_s + 1e-6)[..., None])
    begin = start_estimate(model, windows)
    linear = model.linearise(begin.theta, begin.free, windows, [*along, *model.starts])
    each = (sensors.pos, sensors.attitude, sensors.vel, sensors.gyro, sensors.acc)
    sigma = np.array([*np.repeat(each, 3), *[sensors.rotor] * 4])
    rows = (row_s > 0.0).sum(axis=1).mean() / LENGTH_S
    sigma = np.where(sigma > 0.0, sigma * np.sqrt(rows / sensors.rate_hz), np.nan)
    return rollout_evidence(model, windows, linear, LIMITS, Noise(sigma, {}), along)[1]


def gust_strength(
    nominal: Vehicle,
    ways: Sequence[Trajectory],
    sensors: Sensors,
    name: str,
    rng: np.random.Generator,
) -> float:
    """Return the size of random wind `name` at which the log-likelihood ratio is `THRESHOLD`.

    Beyond the bound of its first parameter, the size s, it is infinite; the others are neutral.
    It adds a covariance to the noise; with lambda its whitened eigenvalues for s = 1, a stretch
    adds (s^2 lambda - log(1 + s^2 lambda)) / 2.
    """
    wind = EFFECTS[name].values(1.0, *neutral(EFFECTS[name], nominal)[1:])
    blown = with_effects(nominal, {name: wind})
    flights = fly(nominal, blown, [*ways] * GUST_DRAWS, sensors.rate_hz, rng=rng)
    logs = [log_of(flight, nominal, sensors, None) for flight in flights]
    left = linearised(nominal, logs, sensors, ()).residual
    left = left.reshape(GUST_DRAWS, -1, left.shape[1])
    gram = np.einsum("kwd,lwd->wkl", left, left) / GUST_DRAWS
    eigenvalues = np.maximum(np.linalg.eigvalsh(gram), 0.0)

    def beyond(log_size: float) -> float:
        raised = np.exp(2.0 * log_size) * eigenvalues
        return float(0.5 * (raised - np.log1p(raised)).sum()) - THRESHOLD

    ends = np.log((1e-4, bound_value(EFFECTS[name].parameters[0].high, nominal)))
    return float(np.exp(root_scalar(beyond, bracket=ends).root)) if beyond(ends[1]) > 0 else np.inf


def log_ratio(matrix: np.ndarray, change: np.ndarray) -> float:
    """Return the expected log-likelihood ratio of a `change` (P,) for information (P, P)."""
    return float(0.5 * change @ matrix @ change)


def detectable(matrix: np.ndarray, direction: np.ndarray) -> float:
    """Return the multiple of `direction` (P,) that is just detectable; infinite if never."""
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
    """Return the log-likelihood ratio that remains if `other` is fitted instead of `instead_of`.

    Args:
        info: of the case's flights.
        truth: change of each true effect's columns from the given vehicle, by name.
        instead_of: the true effect that is left out; the other true ones are fitted too.
        other: fitted in its place, within its physical bounds; only its column `one` if given.
        nominal: the given vehicle.
        one: number of a column.
    """
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
    info: Information, truth: Mapping[str, np.ndarray], nominal: Vehicle
) -> dict[str, dict[str, float]]:
    """Return for each true effect the names that may replace it, with their remaining ratios."""
    found: dict[str, dict[str, float]] = {name: {} for name in truth}
    for other in nameable_effects():
        if other in truth or EFFECTS[other].random:
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
