"""Residuals of force and torque: mean measured accelerations less those of the model.

A moment is one mean over a short smooth window (`data/view.py`). The noise is estimated from the
residual itself. An unchanged vehicle flies each time with a slightly different trim (constant
force or torque), so each flight's mean residual along each axis is a random effect (Laird and Ware
1982). Subtracting a share of that mean makes the rows of a flight independent (quasi-demeaning;
Fuller and Battese 1973). Where flights are compared with reference flights, the trim of these is an
error that all flights share: there a share of the mean of all flights is subtracted as well.
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
from suite.diagnose.data.steps import LONGEST_S
from suite.diagnose.data.view import FlightRows, SmoothedFlight, View
from suite.diagnose.estimate.block import Block, without_nuisance
from suite.diagnose.estimate.gauss_newton import intervals95
from suite.diagnose.estimate.parameters import (
    ParameterLayout,
    ParameterSpace,
    effects_at,
)
from suite.diagnose.evidence.rollouts import VehicleArrays, direction_groups
from suite.diagnose.thresholds import THRESHOLDS, Thresholds

CHUNK = 1024
"""Rows of one call: a fixed shape, compiled once."""
IMU_ACC = FlightRows._fields.index("imu_acc_w")
"""Number of the first field of rows that is not an input of the model."""
LEAST_CORRELATION = 0.05
"""Smaller autocorrelations count as none."""


class RowAccelerations(NamedTuple):
    """Accelerations of the model on N rows."""

    value: np.ndarray
    """(N, 6) dv/dt in the world [m/s^2] and dw/dt in body axes [rad/s^2]."""
    slope: np.ndarray
    """(N, 6, K) along K parameters."""


class ForceModel:
    """A vehicle's accelerations under measured attitude, velocity, rates and rotor speeds."""

    def __init__(self, vehicle: Vehicle, space: ParameterSpace, voltage: bool) -> None:
        """Prepare `vehicle` with the parameters of `space`.

        `voltage` is whether the rows have a battery voltage.
        """
        self.space = space
        base = {name: v for name, v in space.base.items() if EFFECTS[name].by_state}
        self._vehicle = VehicleArrays(*nominal_quadrotor(vehicle), base)
        self._compiled = _accelerations(space.layout, voltage)

    def at(
        self, theta: np.ndarray, rows: FlightRows, indices: Sequence[int] | None = None
    ) -> RowAccelerations:
        """Return the accelerations at the parameters `theta` (P,), with slopes along `indices`.

        With None as indices the slopes are along all parameters.
        """
        count, directions = len(rows.time_s), np.eye(len(theta))
        groups = [directions] if indices is None else direction_groups(directions, indices)
        size = len(theta) if indices is None else len(indices)
        values, slopes = [], []
        with jax.enable_x64(True):
            for first in range(0, count, CHUNK):
                chunk = np.minimum(np.arange(first, first + CHUNK), count - 1)
                inputs = FlightRows(*(np.asarray(field)[chunk] for field in rows[:IMU_ACC]))
                results = [self._compiled(self._vehicle, theta, inputs, group) for group in groups]
                values.append(np.asarray(results[0][0])[: count - first])
                slope = np.concatenate([np.asarray(each) for _, each in results], axis=-1)
                slopes.append(slope[: count - first, :, :size])
        return RowAccelerations(np.concatenate(values), np.concatenate(slopes))


def accelerations_on(plant: Plant, rows: FlightRows, voltage: bool) -> tuple[Array, Array]:
    """Return dv/dt (N, 3) in the world [m/s^2] and dw/dt (N, 3) in body axes [rad/s^2] on `rows`.

    For numpy and JAX. `voltage` is whether the rows have a battery voltage.
    """
    motion, rotors = motion_of(plant, rows), steady(rows.rotor_speed)
    voltage_drop = rows.voltage_drop if voltage else None
    _, flow = wind_and_flow(plant, {}, motion, rotors, rows.time_s, voltage_drop=voltage_drop)
    return accelerations(plant, motion, wrench_on(plant, rotors, flow))


def motion_of(plant: Plant, rows: FlightRows) -> Motion:
    """Return the motion (N, ...) on `rows`, corrected for the faults of the log in `plant`."""
    logged = Sample(rows.pos_w, rows.rot_w, rows.vel_w, rows.rate_b, 0.0 * rows.rate_b)
    return Motion(*to_true(plant.effects, logged)[:4])


@cache
def _accelerations(layout: ParameterLayout, voltage: bool) -> Callable[..., Any]:
    """Return the compiled accelerations and their slopes, the same for every vehicle."""

    def accelerations_at(vehicle: VehicleArrays, theta: Any, rows: FlightRows) -> Any:
        values = effects_at(layout, vehicle.base, theta)
        plant = assemble(vehicle.nominal, vehicle.constants, values, LONGEST_S, 0.0)
        return jnp.concatenate(accelerations_on(plant, rows, voltage), axis=-1)

    def linearised(vehicle: VehicleArrays, theta: Any, rows: FlightRows, directions: Any) -> Any:
        def along(direction: Any) -> Any:
            return jax.jvp(lambda t: accelerations_at(vehicle, t, rows), (theta,), (direction,))

        return jax.vmap(along, out_axes=(None, -1))(directions)

    return jax.jit(linearised)


class ViewData(NamedTuple):
    """M moments (mean accelerations) of all flights, in one view."""

    flight: np.ndarray
    """(M,) number of the flight."""
    middle_s: np.ndarray
    """(M,) since the first row of the flight [s]."""
    value: np.ndarray
    """(M, 3) of the model, body axes."""
    residual: np.ndarray
    """(M, 3) measured - model, body axes."""
    slope: np.ndarray
    """(M, 3, K) of the model along parameters."""
    pose_slope: np.ndarray
    """(M, 3, L) change of the model by one standard deviation of each uncertainty of the pose; L is
    0 where the pose was measured."""


class Weights(NamedTuple):
    """Noise of a view's residuals, by which its rows are weighted."""

    scatter: np.ndarray
    """(3,) RMS of the residual within flights, by axis."""
    memory: np.ndarray
    """(3,) autocorrelation time, in moments."""
    trim: np.ndarray
    """(3,) standard deviation of flights' means; infinite with too few flights."""
    base: np.ndarray | None = None
    """(3,) standard deviation of the error that all flights share, as the mean of the reference
    flights; None without any."""


def compare(
    view: View,
    model: ForceModel,
    theta: np.ndarray,
    flights: Sequence[SmoothedFlight],
    indices: Sequence[int] | None = None,
) -> ViewData:
    """Return the residuals of `flights` at `theta` (P,), with slopes along `indices`.

    With None as indices the slopes are along all parameters.
    """
    parts = []
    for number, flight in enumerate(flights):
        accelerations = model.at(theta, flight.rows, indices)
        mean, count = flight.form.mean, len(flight.form.middle_s)
        value = mean @ accelerations.value[:, view.columns]
        slope = accelerations.slope[:, view.columns]
        slope = (mean @ slope.reshape(len(slope), -1)).reshape(count, *slope.shape[1:])
        value, slope = (_attenuated(part, flight.reliability) for part in (value, slope))
        residual = flight.measured - value
        if view.in_world:
            to_body = np.swapaxes(flight.rows.rot_w[flight.form.middle_row], 1, 2)
            residual, value = ((to_body @ part[..., None])[..., 0] for part in (residual, value))
            slope = to_body @ slope
        excluded = [axis for axis in range(3) if axis not in view.axes]
        residual[:, excluded], slope[:, excluded] = 0.0, 0.0
        pose_slope_b = flight.rows.pose_slope_b if view.in_world else None
        pose_slope = np.zeros((count, 3, 0))
        if pose_slope_b is not None:
            pose_slope = (mean @ pose_slope_b.reshape(len(pose_slope_b), -1)).reshape(count, 3, -1)
        fields = (flight.form.middle_s, value, residual, slope, pose_slope)
        parts.append(ViewData(np.full(count, number), *fields))
    widest = max(part.pose_slope.shape[2] for part in parts)
    for k, part in enumerate(parts):
        padding = ((0, 0), (0, 0), (0, widest - part.pose_slope.shape[2]))
        parts[k] = part._replace(pose_slope=np.pad(part.pose_slope, padding))
    return ViewData(*(np.concatenate(field) for field in zip(*parts, strict=True)))


def _attenuated(series: np.ndarray, reliability: np.ndarray) -> np.ndarray:
    """Return `series` (M, 3, ...), deviations from its mean multiplied by `reliability` (3,)."""
    if not len(series) or (reliability == 1.0).all():
        return series
    mean = series.mean(axis=0)
    return mean + reliability.reshape(3, *[1] * (series.ndim - 2)) * (series - mean)


def means_of(values: np.ndarray, flight: np.ndarray) -> np.ndarray:
    """Return the means (F, ...) of `values` (M, ...) by flight; `flight` (M,) is their number."""
    return np.array([values[flight == number].mean(axis=0) for number in np.unique(flight)])


def centred(values: np.ndarray, flight: np.ndarray) -> np.ndarray:
    """Return `values` (M, ...) less their flights' means; `flight` (M,) is their number."""
    _, place = np.unique(flight, return_inverse=True)
    return values - means_of(values, flight)[place.ravel()]


def validation_groups(flight: np.ndarray) -> np.ndarray:
    """Return the cross-validation group (M,) of each row: its `flight`; thirds of a single one."""
    if len(np.unique(flight)) > 1:
        return flight
    return np.arange(len(flight)) * 3 // len(flight)


def weights_of(data: ViewData, limits: Thresholds = THRESHOLDS) -> Weights:
    """Return the weights estimated from the residuals `data` of the best model."""
    flights = [data.residual[data.flight == n] for n in np.unique(data.flight)]
    deviations = [f - f.mean(axis=0) for f in flights]
    count = sum(len(f) for f in flights)
    power = np.sum([(f**2).sum(axis=0) for f in deviations], axis=0)
    scatter = np.maximum(np.sqrt(power / max(count - len(flights), 1)), 1e-6)
    memory = np.maximum(1.0, _autocorrelation_time(deviations, limits))
    trim = np.full(3, np.inf)
    if len(flights) >= limits.least_flights:
        means = means_of(data.residual, data.flight)
        of_noise = np.mean([scatter**2 * memory / len(f) for f in flights], axis=0)
        trim = np.sqrt(np.maximum(means.var(axis=0, ddof=1) - of_noise, 0.0))
    return Weights(scatter, memory, trim)


def _autocorrelation_time(deviations: list[np.ndarray], limits: Thresholds) -> np.ndarray:
    """Return the autocorrelation time (3,), summed up to the first lag without correlation."""
    power = np.sum([(f**2).sum(axis=0) for f in deviations], axis=0)
    total, correlated = np.ones(3), np.ones(3, bool)
    for lag in range(1, limits.longest_memory):
        product = np.sum([(f[lag:] * f[:-lag]).sum(axis=0) for f in deviations], axis=0)
        correlation = product / np.maximum(power, 1e-300)
        correlated &= correlation > LEAST_CORRELATION
        total += np.where(correlated, 2.0 * correlation, 0.0)
        if not correlated.any():
            break
    return total


def whitened(data: ViewData, weights: Weights) -> tuple[np.ndarray, np.ndarray]:
    """Return residual (M, 3) and slope (M, 3, P) of `data` in units of independent noise."""
    residual, slope = data.residual.copy(), data.slope.copy()
    unit = weights.scatter * np.sqrt(weights.memory)
    for number in np.unique(data.flight):
        rows = data.flight == number
        variance = weights.scatter**2 * weights.memory / rows.sum()
        share = 1.0 - np.sqrt(variance / (variance + weights.trim**2))
        residual[rows] -= share * residual[rows].mean(axis=0)
        slope[rows] -= share[:, None] * slope[rows].mean(axis=0)
        if data.pose_slope.any():
            residual[rows], slope[rows] = _pose_whitened(
                residual[rows], slope[rows], data.pose_slope[rows], unit
            )
    if weights.base is not None:
        # The share is 0 where the trim is infinite, so that flights' means hold no information.
        variance = weights.scatter**2 * weights.memory + weights.trim**2
        share = 1.0 - 1.0 / np.sqrt(1.0 + len(residual) * weights.base**2 / variance)
        residual -= share * residual.mean(axis=0)
        slope -= share[:, None] * slope.mean(axis=0)
    return residual / unit, slope / unit[:, None]


def _pose_whitened(
    residual: np.ndarray, slope: np.ndarray, pose_slope: np.ndarray, unit: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return residual (M, 3) and slope (M, 3, P) of one flight, whitened by its pose's errors.

    These errors are random effects: directions along which `pose_slope` (M, 3, L) is large count
    less. Multiplied is the inverse root of `1 + pose_slope pose_slope'`, in units (3,) of the
    noise.
    """
    count = residual.size
    basis, size, _ = np.linalg.svd(
        (pose_slope / unit[:, None]).reshape(count, -1), full_matrices=False
    )
    shrinkage = 1.0 / np.sqrt(1.0 + size**2) - 1.0

    def shrunk(values: np.ndarray) -> np.ndarray:
        scale = unit.reshape(3, *[1] * (values.ndim - 2))
        flat = (values / scale).reshape(count, -1)
        flat = flat + basis @ (shrinkage[:, None] * (basis.T @ flat))
        return flat.reshape(values.shape) * scale

    return shrunk(residual), shrunk(slope)


def stretch_numbers(data: ViewData, limits: Thresholds = THRESHOLDS) -> np.ndarray:
    """Return the number (M,) of each moment's stretch; stretches count as independent."""
    place = (data.middle_s / limits.view_block_s).astype(int)
    _, stretch = np.unique(np.stack([data.flight, place]), axis=1, return_inverse=True)
    return stretch.ravel()


def block_of(data: ViewData, weights: Weights, stretch: np.ndarray, along: Sequence[int]) -> Block:
    """Return the block (whitened stretches) of `data`.

    Its slopes are `along` these parameters; `stretch` (M,) is the number of each moment's stretch.
    """
    residual, slope = whitened(data, weights)
    first = np.unique(stretch, return_index=True)[1]
    return without_nuisance(
        residual, slope, along, stretch, data.flight[first], data.middle_s[first]
    )


def error_share_removed(before: ViewData, after: ViewData, limits: Thresholds) -> float:
    """Return the share of the squared error of `before` that the model of `after` removes.

    Both are weighted by the noise of `after`; in `before` a slow effect would count as noise.
    """
    noise = weights_of(after, limits)
    chi2_after, chi2_before = (
        float((whitened(data, noise)[0] ** 2).sum()) for data in (after, before)
    )
    return 1.0 - chi2_after / chi2_before


def successive_changes(data: ViewData) -> ViewData:
    """Return the changes in `data` from each moment to the next one of its flight."""
    step = np.diff(data.middle_s)
    usual = np.median(step[step > 0.0])
    near = (np.diff(data.flight) == 0) & (step < 1.5 * usual)
    flight, middle_s, *series = data
    return ViewData(
        flight[1:][near], middle_s[1:][near], *(np.diff(one, axis=0)[near] for one in series)
    )


def fast_share(
    data: ViewData, columns: Sequence[int], change: np.ndarray, limits: Thresholds
) -> tuple[float, float]:
    """Return the share of a fitted effect that fast changes confirm, and that share's uncertainty.

    Motors compensate disturbances of the body. Where a controller balances a slow torque, the
    motors' torque causes no rotation, as with a larger inertia or less thrust. Where the equations
    are right, changes from one moment to the next give the same parameters as all moments do (a
    specification test; Hausman 1978, doi 10.2307/1913827).

    Args:
        data: residuals with the effect in the model.
        columns: of the effect's K parameters in the slopes.
        change: (K,) fitted parameters less those of the vehicle file.
        limits: length of independent stretches.

    Returns:
        The share, 1 where fast changes show the full effect and 0 where they show none of it, to
        first order; and the half-width of its 95 % interval.
    """
    fast = successive_changes(data)
    fast = fast._replace(slope=(fast.slope[..., list(columns)] @ change)[..., None])
    stretch = stretch_numbers(fast, limits)
    equations = block_of(fast, weights_of(fast, limits), stretch, [0]).equations
    hessian, gradient = equations.sums()
    share = 1.0 + float(gradient[0]) / max(float(hessian[0, 0]), 1e-300)
    return share, float(intervals95(equations).half_width[0])
