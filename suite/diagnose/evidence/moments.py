"""Residuals of force and torque: mean measured accelerations less those of the model.

A moment is one mean over a short smooth window (`data/view.py`). The noise is estimated from the
residual itself. Flights have trims of their own: an unchanged vehicle flies each time with a
slightly different trim, so each flight's mean along each axis is a random effect (Laird and Ware
1982). Subtracting a share of the flight's mean makes rows independent of it (quasi-demeaning;
Fuller and Battese 1973). Reference flights have such an error too, which all others share: there
a share of the mean of all flights is subtracted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from eval.effects import EFFECTS
from eval.effects.interface import Array, Sample
from eval.effects.log_faults import to_true
from eval.quadrotor.forces import wind_and_flow, wrench_on
from eval.quadrotor.plant import Motion, Plant, accelerations, assemble, nominal_quadrotor
from eval.quadrotor.rotors import steady
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.sampling import LONGEST_S
from suite.diagnose.data.view import FlightRows, SmoothedFlight, View
from suite.diagnose.estimate.block import Block, without_nuisance
from suite.diagnose.estimate.gauss_newton import intervals95
from suite.diagnose.estimate.parameters import (
    ParameterLayout,
    ParameterSpace,
    effects_at,
)
from suite.diagnose.evidence.rollouts import VehicleArrays, grouped
from suite.diagnose.thresholds import THRESHOLDS, Thresholds

CHUNK = 1024
"""Rows a call: one shape, compiled once."""


IMU_ACC = FlightRows._fields.index("imu_acc_w")
"""Fields of rows from here on are no input of a model."""


class RowForces(NamedTuple):
    """What the equations give on N rows."""

    value: np.ndarray
    """(N, 6) dv/dt in the world [m/s^2] and dw/dt in body axes [rad/s^2]."""
    slope: np.ndarray
    """(N, 6, K) along numbers."""


class ForceModel:
    """A vehicle's accelerations under measured attitude, velocity, rates and rotor speeds."""

    def __init__(self, vehicle: Vehicle, space: ParameterSpace, voltage: bool) -> None:
        """Prepare `vehicle` with the numbers of `space`; `voltage`: whether the rows have one."""
        self.space = space
        base = {name: v for name, v in space.base.items() if EFFECTS[name].by_state}
        self._given = VehicleArrays(*nominal_quadrotor(vehicle), base)
        self._compiled = _forces(space.layout, voltage)

    def at(
        self, theta: np.ndarray, rows: FlightRows, indices: Sequence[int] | None = None
    ) -> RowForces:
        """Return what acts at the numbers `theta` (P,), and how it changes along each of `indices`.

        Along all numbers if not given.
        """
        count, everything = len(rows.time_s), np.eye(len(theta))
        directions = [everything] if indices is None else grouped(everything, indices)
        size = len(theta) if indices is None else len(indices)
        values, slopes = [], []
        with jax.enable_x64(True):
            for first in range(0, count, CHUNK):
                at = np.minimum(np.arange(first, first + CHUNK), count - 1)
                part = FlightRows(*(np.asarray(field)[at] for field in rows[:IMU_ACC]))
                made = [self._compiled(self._given, theta, part, group) for group in directions]
                values.append(np.asarray(made[0][0])[: count - first])
                slope = np.concatenate([np.asarray(each) for _, each in made], axis=-1)
                slopes.append(slope[: count - first, :, :size])
        return RowForces(np.concatenate(values), np.concatenate(slopes))


def accelerations_on(plant: Plant, rows: FlightRows, voltage: bool) -> tuple[Array, Array]:
    """Return dv/dt (N, 3) in the world [m/s^2] and dw/dt (N, 3) in body axes [rad/s^2] on `rows`.

    Numpy or JAX; `voltage`: whether the rows have one.
    """
    motion, rotors = motion_of(plant, rows), steady(rows.rotor_speed)
    voltage_drop = rows.voltage_drop if voltage else None
    _, flow = wind_and_flow(plant, {}, motion, rotors, rows.time_s, voltage_drop=voltage_drop)
    return accelerations(plant, motion, wrench_on(plant, rotors, flow))


def motion_of(plant: Plant, rows: FlightRows) -> Motion:
    """Return how the body moved (N, ...) where the faults of the log among the effects are true."""
    logged = Sample(rows.pos_w, rows.rot_w, rows.vel_w, rows.rate_b, 0.0 * rows.rate_b)
    return Motion(*to_true(plant.effects, logged)[:4])


@cache
def _forces(layout: ParameterLayout, voltage: bool) -> Callable[..., Any]:
    """Return the compiled accelerations and their slopes, the same for every vehicle."""

    def act(given: VehicleArrays, theta: Any, rows: FlightRows) -> Any:
        values = effects_at(layout, given.base, theta)
        plant = assemble(given.nominal, given.constants, values, LONGEST_S, 0.0)
        return jnp.concatenate(accelerations_on(plant, rows, voltage), axis=-1)

    def both(given: VehicleArrays, theta: Any, rows: FlightRows, directions: Any) -> Any:
        def along(direction: Any) -> Any:
            return jax.jvp(lambda t: act(given, t, rows), (theta,), (direction,))

        return jax.vmap(along, out_axes=(None, -1))(directions)

    return jax.jit(both)


class ViewData(NamedTuple):
    """M smoothed moments of all flights, in one view."""

    flight: np.ndarray
    """(M,) number of the flight."""
    middle_s: np.ndarray
    """(M,) since the first row of the flight [s]."""
    value: np.ndarray
    """(M, 3) the model's, body axes."""
    residual: np.ndarray
    """(M, 3) measured - model, body axes."""
    slope: np.ndarray
    """(M, 3, K) of the model along numbers."""
    pose_slope: np.ndarray
    """(M, 3, L) what is not known of the pose makes of the model, by standard deviations; L may be
    0."""


class Weights(NamedTuple):
    """Noise of a view's residuals, by which its rows are weighted."""

    scatter: np.ndarray
    """(3,) RMS of the residual within flights, by axis."""
    memory: np.ndarray
    """(3,) autocorrelation time, in moments."""
    trim: np.ndarray
    """(3,) standard deviation of flights' means; infinite where too few flights show it."""
    base: np.ndarray | None = None
    """(3,) standard deviation of what all flights are judged from, where only their means count;
    None where that is known."""


def compare(
    view: View,
    model: ForceModel,
    theta: np.ndarray,
    flights: Sequence[SmoothedFlight],
    indices: Sequence[int] | None = None,
) -> ViewData:
    """Return residuals of `flights` at `theta` (P,), slopes along `indices` or all numbers."""
    parts = []
    for number, flight in enumerate(flights):
        forces = model.at(theta, flight.rows, indices)
        mean, count = flight.form.mean, len(flight.form.middle_s)
        value = mean @ forces.value[:, view.columns]
        slope = forces.slope[:, view.columns]
        slope = (mean @ slope.reshape(len(slope), -1)).reshape(count, *slope.shape[1:])
        value, slope = (_attenuated(part, flight.reliability) for part in (value, slope))
        residual = flight.measured - value
        if view.in_world:
            to_body = np.swapaxes(flight.rows.rot_w[flight.form.middle_row], 1, 2)
            residual, value = ((to_body @ part[..., None])[..., 0] for part in (residual, value))
            slope = to_body @ slope
        unseen = [axis for axis in range(3) if axis not in view.axes]
        residual[:, unseen], slope[:, unseen] = 0.0, 0.0
        pose_slope_b = flight.rows.pose_slope_b if view.in_world else None
        pose_slope = np.zeros((count, 3, 0))
        if pose_slope_b is not None:
            pose_slope = (mean @ pose_slope_b.reshape(len(pose_slope_b), -1)).reshape(count, 3, -1)
        about = (flight.form.middle_s, value, residual, slope, pose_slope)
        parts.append(ViewData(np.full(count, number), *about))
    widest = max(part.pose_slope.shape[2] for part in parts)
    parts = [
        part._replace(
            pose_slope=np.pad(
                part.pose_slope, ((0, 0), (0, 0), (0, widest - part.pose_slope.shape[2]))
            )
        )
        for part in parts
    ]
    return ViewData(*(np.concatenate(field) for field in zip(*parts, strict=True)))


def _attenuated(series: np.ndarray, reliability: np.ndarray) -> np.ndarray:
    """Return `series` (M, 3, ...), its changes about the mean multiplied by `reliability` (3,)."""
    if not len(series) or (reliability == 1.0).all():
        return series
    mean = series.mean(axis=0)
    return mean + reliability.reshape(3, *[1] * (series.ndim - 2)) * (series - mean)


def means_of(values: np.ndarray, flight: np.ndarray) -> np.ndarray:
    """Return the mean (F, ...) of `values` (M, ...) over each flight; `flight` (M,) numbers it."""
    return np.array([values[flight == number].mean(axis=0) for number in np.unique(flight)])


def centred(values: np.ndarray, flight: np.ndarray) -> np.ndarray:
    """Return `values` (M, ...) less the mean of each's flight."""
    _, place = np.unique(flight, return_inverse=True)
    return values - means_of(values, flight)[place.ravel()]


def units_of(flight: np.ndarray) -> np.ndarray:
    """Return the cross-validation group (M,) of each row: its flight, or a third of a lone one."""
    if len(np.unique(flight)) > 1:
        return flight
    return np.arange(len(flight)) * 3 // len(flight)


def weights_of(data: ViewData, limits: Thresholds = THRESHOLDS) -> Weights:
    """Return the weights by `data`, the best model's."""
    flights = [data.residual[data.flight == n] for n in np.unique(data.flight)]
    inside = [f - f.mean(axis=0) for f in flights]
    count = sum(len(f) for f in inside)
    power = np.sum([(f**2).sum(axis=0) for f in inside], axis=0)
    scatter = np.sqrt(power / max(count - len(inside), 1))
    scatter = np.maximum(scatter, 1e-6)
    memory = np.maximum(1.0, _memory(inside, limits))
    trim = np.full(3, np.inf)
    if len(flights) >= limits.least_flights:
        means = means_of(data.residual, data.flight)
        own = np.mean([scatter**2 * memory / len(f) for f in flights], axis=0)
        trim = np.sqrt(np.maximum(means.var(axis=0, ddof=1) - own, 0.0))
    return Weights(scatter, memory, trim)


def _memory(inside: list[np.ndarray], limits: Thresholds) -> np.ndarray:
    """Return the autocorrelation time (3,), summed up to the first lag without correlation."""
    power = np.sum([(f**2).sum(axis=0) for f in inside], axis=0)
    total, alive = np.ones(3), np.ones(3, bool)
    for lag in range(1, limits.longest_memory):
        product = np.sum([(f[lag:] * f[:-lag]).sum(axis=0) for f in inside], axis=0)
        share = product / np.maximum(power, 1e-300)
        alive &= share > 0.05
        total += np.where(alive, 2.0 * share, 0.0)
        if not alive.any():
            break
    return total


def whitened(data: ViewData, weights: Weights) -> tuple[np.ndarray, np.ndarray]:
    """Return residual (M, 3) and slope (M, 3, P) of `data` in units of independent noise."""
    residual, slope = data.residual.copy(), data.slope.copy()
    for number in np.unique(data.flight):
        rows = data.flight == number
        own = weights.scatter**2 * weights.memory / rows.sum()
        share = 1.0 - np.sqrt(own / (own + weights.trim**2))
        residual[rows] -= share * residual[rows].mean(axis=0)
        slope[rows] -= share[:, None] * slope[rows].mean(axis=0)
        if data.pose_slope.any():
            unit = weights.scatter * np.sqrt(weights.memory)
            residual[rows], slope[rows] = _pose_whitened(
                residual[rows], slope[rows], data.pose_slope[rows], unit
            )
    if weights.base is not None:
        # Where flights' means hold no information this is 0.
        own = weights.scatter**2 * weights.memory + weights.trim**2
        share = 1.0 - 1.0 / np.sqrt(1.0 + len(residual) * weights.base**2 / own)
        residual -= share * residual.mean(axis=0)
        slope -= share[:, None] * slope.mean(axis=0)
    unit = weights.scatter * np.sqrt(weights.memory)
    return residual / unit, slope / unit[:, None]


def _pose_whitened(
    residual: np.ndarray, slope: np.ndarray, pose_slope: np.ndarray, unit: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return residual (M, 3) and slope (M, 3, P) of one flight as if its pose were known.

    Its errors are random effects: directions along which `pose_slope` (M, 3, L) is large count less
    (whitening by the inverse root of `1 + pose_slope pose_slope'`, in units (3,) of the noise).
    """
    count = residual.size
    basis, size, _ = np.linalg.svd(
        (pose_slope / unit[:, None]).reshape(count, -1), full_matrices=False
    )
    less = 1.0 / np.sqrt(1.0 + size**2) - 1.0

    def steady(values: np.ndarray) -> np.ndarray:
        scale = unit.reshape(3, *[1] * (values.ndim - 2))
        flat = (values / scale).reshape(count, -1)
        return (flat + basis @ (less[:, None] * (basis.T @ flat))).reshape(values.shape) * scale

    return steady(residual), steady(slope)


def stretch_of(data: ViewData, limits: Thresholds = THRESHOLDS) -> np.ndarray:
    """Return the number of each moment's stretch (M,): parts of a flight that stand apart."""
    inside = (data.middle_s / limits.view_block_s).astype(int)
    _, stretch = np.unique(np.stack([data.flight, inside]), axis=1, return_inverse=True)
    return stretch.ravel()


def block_of(data: ViewData, weights: Weights, stretch: np.ndarray, along: Sequence[int]) -> Block:
    """Return the block of `data`, slopes `along` these; `stretch` (M,) is each moment's number."""
    residual, slope = whitened(data, weights)
    first = np.unique(stretch, return_index=True)[1]
    return without_nuisance(
        residual, slope, along, stretch, data.flight[first], data.middle_s[first]
    )


def share_taken(now: ViewData, then: ViewData, limits: Thresholds) -> float:
    """Return the share of the squared error of `now` that `then` takes away.

    Weighed by the noise that `then` leaves: by that of `now` a slow effect is noise with a memory.
    """
    noise = weights_of(then, limits)
    left, had = (float((whitened(one, noise)[0] ** 2).sum()) for one in (then, now))
    return 1.0 - left / had


def changes_of(data: ViewData) -> ViewData:
    """Return what changes in `data` from each moment to the next one of its flight."""
    step = np.diff(data.middle_s)
    usual = np.median(step[step > 0.0])
    near = (np.diff(data.flight) == 0) & (step < 1.5 * usual)
    flight, middle_s, *series = data
    return ViewData(
        flight[1:][near], middle_s[1:][near], *(np.diff(one, axis=0)[near] for one in series)
    )


def fast_share(
    data: ViewData, columns: Sequence[int], away: np.ndarray, limits: Thresholds
) -> tuple[float, float]:
    """Return which share of a named effect fast changes confirm, and the uncertainty of that share.

    Motors compensate what disturbs the body. Where a controller balances a slow torque, the
    motors' torque causes no rotation, as with a larger inertia or less thrust. Where the equations
    are right, changes from one moment to the next give the same numbers as all moments do (a
    specification test; Hausman 1978, doi 10.2307/1913827).

    Args:
        data: with the name in the model.
        columns: of its K numbers.
        away: (K,) how far they are from the vehicle file's.
        limits: of independent stretches.

    Returns:
        1 where fast changes show the same, 0 where they show none of it, to first order; and
        half of its 95 % interval.
    """
    fast = changes_of(data)
    fast = fast._replace(slope=(fast.slope[..., list(columns)] @ away)[..., None])
    block = block_of(fast, weights_of(fast, limits), stretch_of(fast, limits), [0]).equations
    hessian, gradient = block.sums()
    share = 1.0 + float(gradient[0]) / max(float(hessian[0, 0]), 1e-300)
    return share, float(intervals95(block).half_width[0])
