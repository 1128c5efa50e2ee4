"""The oracle of the blind cases: how well flights determine each parameter of an effect.

It decides how strong the hidden effects are, and which alternatives an answer requires and allows,
without the result of a diagnosis. With g the Jacobian of all logged channels, divided by their
noise, the Fisher information of flights is G = g^T g. To first order a parameter change theta from
the nominal vehicle has the expected log-likelihood ratio theta^T G theta / 2. This is half of the
squared change of the channels, in standard deviations of the noise. The part of it that remains
after a fit of another effect is a Schur complement of G.

g is the linearisation of rollouts (short simulated flights) at the nominal vehicle, along flights
without noise. The rollouts are those of the diagnosis, so errors of them are also errors of the
oracle. The simulators of the cases do not depend on them.

A change is just detectable if its ratio is `THRESHOLD`. The table of these strengths is a file of
the suite, which `suite blind strengths` writes. The strength of an effect that is not in the table,
such as one of a plugin, is computed when it is needed.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import lsq_linear, root_scalar

from eval.effects import EFFECTS, all_values, nameable_effects
from eval.effects.interface import Parameter, Values, bound_value, neutral
from eval.flights.simulate import SENSORS, Sensors, fly, log_of
from eval.flights.trajectory import Trajectory, long_flights, ordinary_flights
from eval.logs.flight_log import FlightLog
from eval.quadrotor.vehicle_file import load_vehicle
from eval.vehicles.vehicle import Vehicle, with_effects
from suite.common.console import Console
from suite.diagnose.data.noise import Noise
from suite.diagnose.data.windows import LENGTH_S
from suite.diagnose.estimate.block import Block
from suite.diagnose.evidence.rollouts import rollout_evidence, rollouts_along
from suite.diagnose.thresholds import THRESHOLDS
from tracks.common.files import write_json
from tracks.common.provenance import stamp

SHORT_S, LONG_S = 0.5, LENGTH_S
"""Lengths of short and long rollouts [s]. Long ones are more sensitive: the displacement by a force
grows with the square of time."""
THRESHOLD = 12.5
"""Expected log-likelihood ratio of a just detectable effect: five standard deviations (5^2 / 2)."""
REQUIRED = 0.125
"""An effect that leaves a smaller log-likelihood ratio in long rollouts must be an alternative. It
is half a standard deviation, or two of them in rollouts of twice the length."""
ALLOWED = THRESHOLD
"""Only an effect that leaves a smaller ratio in short rollouts may be an alternative."""
MOSTLY = 0.25
"""Only an effect that leaves less than this share of the ratio of the true effect may be an
alternative."""
GUST_DRAWS = 24
"""Number of flights with random wind on each trajectory, to estimate the covariance of the wind."""
LIMITS = replace(THRESHOLDS, most_windows=100_000)
"""Thresholds of the diagnosis, but with no limit on the number of windows."""
SCHEMA = 1
"""Version of the table."""
TABLE = Path(__file__).parent / "strengths.json"
"""File of the table of strengths."""
VEHICLES = Path(__file__).parent / "vehicles"
"""Folder of the nominal vehicles of the cases."""
FLIGHTS_SEED = 7_000_000
"""Seed of the flights from which the table is computed; no case uses it."""


class Column(NamedTuple):
    """One component of one parameter; it belongs to a column of the Jacobian."""

    effect: str
    parameter: str
    component: int
    """Index of the component; 0 for a plain number."""

    @property
    def spec(self) -> Parameter:
        """The description of the parameter in the catalogue."""
        parameters = EFFECTS[self.effect].parameters
        return next(parameter for parameter in parameters if parameter.name == self.parameter)

    def value(self, values: Values) -> float:
        """Return the component from the `values` of its effect."""
        return float(np.ravel(getattr(values, self.parameter))[self.component])

    def room(self, nominal: Vehicle) -> tuple[float, float]:
        """Return the largest allowed changes from the value in the nominal vehicle.

        They are the change downwards (negative or 0) and the change upwards.
        """
        value = self.value(all_values(nominal)[self.effect])
        return bound_value(self.spec.low, nominal) - value, bound_value(
            self.spec.high, nominal
        ) - value


@dataclass(frozen=True)
class Information:
    """The information G of flights with one set of sensors."""

    columns: tuple[Column, ...]
    """The P parameter components."""
    matrix: np.ndarray
    """(P, P) the information G; rows and columns are in the order of `columns`, and units are those
    of the parameters."""

    def rows_of(self, effect: str) -> list[int]:
        """Return the indices of the columns of `effect`."""
        return [i for i, column in enumerate(self.columns) if column.effect == effect]

    def block(self, effect: str) -> np.ndarray:
        """Return the part of the matrix that belongs to `effect`."""
        rows = self.rows_of(effect)
        return self.matrix[np.ix_(rows, rows)]


def columns_of(has_voltage: bool, names: Sequence[str] | None = None) -> tuple[Column, ...]:
    """Return the identifiable components of the effects `names`, or of all effects.

    Effects that are no function of the vehicle's state (random wind) have none here.
    """
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
    """Return the information of flights about the effects `names`, or about all effects.

    The other arguments are those of `linearised`.
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
    """Return the residual and the Jacobian of rollouts along logs, divided by the noise.

    The states at the starts of the rollouts are unknown: the part of residual and Jacobian that
    they could explain is removed (projected out). The logs have no noise; `sensors` has that of the
    channels. Rows at another rate get the same weight per second. The rollouts are `horizon_s`
    long, and start so far apart [s].
    """
    integrator = logs[0].integrator or "continuous"
    # Rollouts with logged commands as input (False: not with measured rotor speeds).
    model, windows, start = rollouts_along(
        logs, nominal, False, bool(sensors.voltage), integrator, horizon_s, LIMITS
    )
    entries = [Column(e.effect, e.parameter, e.component or 0) for e in model.space.entries]
    along = [entries.index(column) for column in columns]
    row_s = np.asarray(windows.row_s)
    # Rows after the horizon do not count.
    windows = windows._replace(valid=windows.valid & (row_s < horizon_s + 1e-6)[..., None])
    linear = model.linearise(start, windows, [*along, *model.starts])
    # Noise of the channels; scaled to the rate of the rows, NaN for a channel that is not logged.
    vector_sigmas = (sensors.pos, sensors.attitude, sensors.vel, sensors.gyro, sensors.acc)
    sigma = np.array([*np.repeat(vector_sigmas, 3), *[sensors.rotor] * 4])
    row_hz = (row_s > 0.0).sum(axis=1).mean() / LENGTH_S
    sigma = np.where(sigma > 0.0, sigma * np.sqrt(row_hz / sensors.rate_hz), np.nan)
    return rollout_evidence(model, linear, LIMITS, Noise(sigma, {}), along)[1]


def gust_strength(
    nominal: Vehicle,
    trajectories: Sequence[Trajectory],
    sensors: Sensors,
    name: str,
    rng: np.random.Generator,
) -> float:
    """Return the size of a random wind at which the log-likelihood ratio is `THRESHOLD`.

    The wind adds a covariance to the noise. Let lambda be an eigenvalue of this covariance in a
    window (a short part of a flight) at size s = 1, divided by the noise. Each lambda adds
    (s^2 lambda - log(1 + s^2 lambda)) / 2 to the ratio.

    Args:
        nominal: the nominal vehicle.
        trajectories: trajectories of the flights.
        sensors: logged channels and their noise.
        name: name of the effect; s is its first parameter, and the others have no influence.
        rng: random generator of the wind.

    Returns:
        The size s; infinite if it is beyond the upper bound of the parameter.
    """
    wind = EFFECTS[name].values(1.0, *neutral(EFFECTS[name], nominal)[1:])
    windy = with_effects(nominal, {name: wind})
    flights = fly(nominal, windy, [*trajectories] * GUST_DRAWS, sensors.rate_hz, rng=rng)
    logs = [log_of(flight, nominal, sensors, None) for flight in flights]
    residual = linearised(nominal, logs, sensors, ()).residual
    residual = residual.reshape(GUST_DRAWS, -1, residual.shape[1])
    # The small matrix of products (draws x draws) has the same eigenvalues as the covariance.
    gram = np.einsum("kwd,lwd->wkl", residual, residual) / GUST_DRAWS
    eigenvalues = np.maximum(np.linalg.eigvalsh(gram), 0.0)

    def excess(log_size: float) -> float:
        """Return the log-likelihood ratio above THRESHOLD for the logarithm of a size s."""
        scaled = np.exp(2.0 * log_size) * eigenvalues
        return float(0.5 * (scaled - np.log1p(scaled)).sum()) - THRESHOLD

    ends = np.log((1e-4, bound_value(EFFECTS[name].parameters[0].high, nominal)))
    return float(np.exp(root_scalar(excess, bracket=ends).root)) if excess(ends[1]) > 0 else np.inf


def log_ratio(matrix: np.ndarray, change: np.ndarray) -> float:
    """Return the expected log-likelihood ratio of a `change` (P,), for the information (P, P)."""
    return float(0.5 * change @ matrix @ change)


def detectable(matrix: np.ndarray, direction: np.ndarray) -> float:
    """Return the multiple of `direction` (P,) that is just detectable; infinite if none is."""
    ratio = log_ratio(matrix, direction)
    return float(np.sqrt(THRESHOLD / ratio)) if ratio > 1e-12 else float("inf")


def remaining_ratio(
    info: Information,
    truth: Mapping[str, np.ndarray],
    instead_of: str,
    other: str,
    nominal: Vehicle,
    column: int | None = None,
) -> float:
    """Return the log-likelihood ratio that remains if `other` is fitted instead of `instead_of`.

    `truth` maps each true effect to the change of its components from the nominal vehicle. The
    other true effects are fitted, too. `other` is fitted within its physical bounds; with `column`,
    only this component of it.
    """
    others_true = [row for name in truth if name != instead_of for row in info.rows_of(name)]
    replaced, fitted = info.rows_of(instead_of), info.rows_of(other)
    fitted = fitted if column is None else [fitted[column]]
    used, count = [*replaced, *fitted, *others_true], len(replaced)
    # Bounded least squares, with a square root of the information as the design matrix. Parameters
    # are scaled, so that the diagonal of the information is 1.
    matrix = info.matrix[np.ix_(used, used)]
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    target = root[:, :count] @ (truth[instead_of] * scale[:count])
    free = [(-np.inf, np.inf)] * len(others_true)
    room = np.array([*(info.columns[row].room(nominal) for row in fitted), *free]).T
    low, high = room * scale[count:] + np.array([[-1e-12], [1e-12]])
    return float(lsq_linear(root[:, count:], target, (low, high)).cost)


def alternatives(
    info: Information, truth: Mapping[str, np.ndarray], nominal: Vehicle
) -> dict[str, dict[str, float]]:
    """Return true effect -> possible alternative -> log-likelihood ratio that remains with it.

    Arguments are those of `remaining_ratio`.
    """
    by_effect: dict[str, dict[str, float]] = {name: {} for name in truth}
    for other in nameable_effects():
        if other in truth or EFFECTS[other].random:
            continue
        # Some effects change one component only: a weak motor is one rotor, and all four together
        # would imitate a thrust scale.
        rows = info.rows_of(other)
        one_at_a_time = any(info.columns[row].spec.one_at_a_time for row in rows)
        columns = range(len(rows)) if one_at_a_time else (None,)
        for name in truth:
            full_ratio = log_ratio(info.block(name), truth[name])
            remaining = min(
                remaining_ratio(info, truth, name, other, nominal, column) for column in columns
            )
            if remaining < min(ALLOWED, MOSTLY * full_ratio):
                by_effect[name][other] = remaining
    return by_effect


def nominal_vehicle(name: str) -> Vehicle:
    """Return a nominal vehicle of the cases by its name, `bare` or `dragged`."""
    return load_vehicle(VEHICLES / f"{name}.toml")


def vehicle_names() -> list[str]:
    """Return the names of the nominal vehicles."""
    return sorted(path.stem for path in VEHICLES.glob("*.toml"))


def write_table(console: Console) -> Path:
    """Write the table of strengths, and return its path.

    It has the entries of every effect, for every nominal vehicle and set of sensors.
    """
    settings = list(product(vehicle_names(), SENSORS))
    entries: dict[str, Any] = {name: {} for name in vehicle_names()}
    with console.progress("strengths", len(settings)) as update:
        for done, (name, sensors) in enumerate(settings, 1):
            entries[name][sensors] = strengths(name, sensors, nameable_effects())
            update(done, f"{name}, {sensors}")
    table = {**stamp(SCHEMA, FLIGHTS_SEED), "threshold": THRESHOLD, "vehicles": entries}
    write_json(TABLE, table)
    _entry.cache_clear()
    return TABLE


def strengths(vehicle: str, sensors: str, names: Sequence[str]) -> dict[str, Any]:
    """Compute the entries of the effects `names` in the table.

    An entry has `columns` (names and indices of the parameter components), and `matrix`, the
    information about them. A random effect has `detectable` instead of `matrix`, the just
    detectable size of its first parameter. `sensors` names the logged channels and their noise, a
    key of `SENSORS`.
    """
    nominal, entries, channels = nominal_vehicle(vehicle), {}, SENSORS[sensors]
    rng = np.random.default_rng(FLIGHTS_SEED)
    # Slow effects, such as an empty battery, need long flights.
    ordinary, long = ordinary_flights(rng), long_flights(rng)
    for slow, trajectories in ((False, ordinary), (True, long)):
        steady = [n for n in names if EFFECTS[n].slow == slow and not EFFECTS[n].random]
        if steady:
            flights = fly(nominal, nominal, trajectories, channels.rate_hz)
            logs = [log_of(flight, nominal, channels, None) for flight in flights]
            info = information(nominal, logs, channels, steady)
            for name in steady:
                columns = [list(info.columns[row][1:]) for row in info.rows_of(name)]
                entries[name] = {"columns": columns, "matrix": info.block(name).tolist()}
    for name in (n for n in names if EFFECTS[n].random):
        size = gust_strength(nominal, ordinary, channels, name, np.random.default_rng(FLIGHTS_SEED))
        entries[name] = {"columns": [[EFFECTS[name].parameters[0].name, 0]], "detectable": size}
    return entries


def columns_in_table(vehicle: str, sensors: str, effect: str) -> list[Column]:
    """Return the parameter components of `effect` in the table, which define its strength."""
    return [Column(effect, str(p), int(c)) for p, c in _entry(vehicle, sensors, effect)["columns"]]


def detectable_along(vehicle: str, sensors: str, effect: str, direction: np.ndarray) -> float:
    """Return the multiple of a direction that is just detectable; infinite if none is.

    The direction (P,) is a change of each of `columns_in_table`; `sensors` is a key of `SENSORS`.
    """
    entry = _entry(vehicle, sensors, effect)
    if "matrix" in entry:
        return detectable(np.array(entry["matrix"]), direction)
    size = entry["detectable"]
    return float("inf") if size is None else size / float(abs(direction[0]))


@cache
def _entry(vehicle: str, sensors: str, effect: str) -> dict[str, Any]:
    """Return the entry of an effect in the table; it is computed if the table lacks it."""
    stored = json.loads(TABLE.read_text(encoding="utf-8"))["vehicles"][vehicle][sensors].get(effect)
    return strengths(vehicle, sensors, [effect])[effect] if stored is None else stored
