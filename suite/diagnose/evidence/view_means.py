"""Residuals of force and torque: measured mean accelerations minus those of the model.

Each mean is taken over a short smooth window (`data/view.py`). The noise is estimated from the
residual itself. An unchanged vehicle has a slightly different trim (constant force or torque) in
each flight. So the mean residual of a flight along each axis contains a random error that all its
rows share (a random effect; Laird and Ware 1982). After a share of that mean is subtracted, the
rows of a flight are independent (quasi-demeaning; Fuller and Battese 1973). If flights are compared
with reference flights, the mean of the latter has an error that all flights share. Then a share of
the mean of all flights is subtracted, too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from eval.effects.interface import Array
from eval.quadrotor.forces import wind_and_flow, wrench_on
from eval.quadrotor.plant import Plant, accelerations, assemble
from eval.quadrotor.rotors import steady
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.steps import LONGEST_S
from suite.diagnose.data.view import FlightRows
from suite.diagnose.estimate.block import Block, less_nuisance, without_nuisance
from suite.diagnose.estimate.gauss_newton import intervals95
from suite.diagnose.estimate.parameters import ParameterLayout, effects_at, make_space
from suite.diagnose.evidence.linearise import VehicleArrays, arrays_of, linearised, slopes_along
from suite.diagnose.thresholds import THRESHOLDS, Thresholds

CHUNK = 1024
"""Number of rows in one call of the compiled model."""
LEAST_CORRELATION = 0.05
"""Smaller autocorrelations count as 0."""


class ForceModel:
    """Model of a vehicle's accelerations at measured attitude, velocity, rates and rotor speeds."""

    def __init__(self, vehicle: Vehicle, voltage: bool) -> None:
        """Prepare `vehicle`; `voltage` says whether the rows have a battery voltage."""
        self.space = make_space(vehicle)
        self._vehicle = arrays_of(vehicle, self.space)
        self._compiled = _accelerations(self.space.layout, voltage)

    def at(
        self, theta: np.ndarray, rows: FlightRows, indices: Sequence[int] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the accelerations (N, 6) at `theta` (P,), and their slopes (N, 6, K).

        They are linear in world axes [m/s^2], then angular in body axes [rad/s^2]. The slopes are
        along the parameters at `indices`, or along all with None.
        """
        inputs = rows._replace(imu_acc_w=None, pose_slope_b=None)
        none = np.zeros((len(rows.time_s), 0))
        return linearised(self._compiled, self._vehicle, theta, none, inputs, indices, CHUNK)


@cache
def _accelerations(layout: ParameterLayout, voltage: bool) -> Callable[..., Any]:
    """Return a compiled function that computes accelerations and their slopes for any vehicle."""

    def accelerations_at(given: VehicleArrays, theta: Any, _: Any, rows: FlightRows) -> Any:
        values = effects_at(layout, given.base, theta)
        plant = assemble(given.nominal, given.constants, values, LONGEST_S, 0.0)
        return jnp.concatenate(accelerations_on(plant, rows, voltage), axis=-1)

    return jax.jit(slopes_along(accelerations_at))


def accelerations_on(plant: Plant, rows: FlightRows, voltage: bool) -> tuple[Array, Array]:
    """Return linear (N, 3) and angular (N, 3) acceleration of the vehicle model `plant` on `rows`.

    The first is in world axes [m/s^2], the second in body axes [rad/s^2]. `voltage` says whether
    the rows have a battery voltage. For numpy and JAX.
    """
    rotors, voltage_drop = steady(rows.rotor_speed), rows.voltage_drop if voltage else None
    _, flow = wind_and_flow(plant, {}, rows.motion, rotors, rows.time_s, voltage_drop=voltage_drop)
    return accelerations(plant, rows.motion, wrench_on(plant, rotors, flow))


class ViewData(NamedTuple):
    """M mean accelerations of all flights, in one view."""

    flight: np.ndarray
    """(M,) number of the flight."""
    middle_s: np.ndarray
    """(M,) middle of each mean's window, from the first row of the flight [s]."""
    value: np.ndarray
    """(M, 3) mean accelerations of the model, in body axes."""
    residual: np.ndarray
    """(M, 3) measured - model, in body axes."""
    slope: np.ndarray
    """(M, 3, K) derivative of the model's values by K parameters."""
    pose_slope: np.ndarray
    """(M, 3, L) change of the model's values by one standard deviation of each of L unknown numbers
    of the pose; L is 0 if the pose was measured."""


class Weights(NamedTuple):
    """Noise of a view's residuals, by which its rows are weighted."""

    scatter: np.ndarray
    """(3,) RMS of the residual about the flights' means, by axis."""
    memory: np.ndarray
    """(3,) autocorrelation time of the residual, as a number of means, by axis."""
    trim: np.ndarray
    """(3,) standard deviation of the flights' trims by axis; infinite with too few flights."""
    base: np.ndarray | None = None
    """(3,) standard deviation of an error that all flights share, by axis; None if there is none.
    The mean of reference flights has such an error."""


def means_of(values: np.ndarray, flight: np.ndarray) -> np.ndarray:
    """Return the means (F, ...) of `values` (M, ...) over each flight, by its number (M,)."""
    return np.array([values[flight == number].mean(axis=0) for number in np.unique(flight)])


def centred(values: np.ndarray, flight: np.ndarray) -> np.ndarray:
    """Return `values` (M, ...) minus the mean of their flight; `flight` (M,) is its number."""
    _, flight_place = np.unique(flight, return_inverse=True)
    return values - means_of(values, flight)[flight_place.ravel()]


def weights_of(data: ViewData, limits: Thresholds = THRESHOLDS) -> Weights:
    """Return the weights, estimated from the residuals `data`."""
    flights = [data.residual[data.flight == n] for n in np.unique(data.flight)]
    deviations = [f - f.mean(axis=0) for f in flights]
    count = sum(len(f) for f in flights)
    power = np.sum([(f**2).sum(axis=0) for f in deviations], axis=0)
    scatter = np.maximum(np.sqrt(power / max(count - len(flights), 1)), 1e-6)
    # The autocorrelation time in means is a sum up to the first uncorrelated lag.
    memory, correlated = np.ones(3), np.ones(3, bool)
    for lag in range(1, limits.longest_memory):
        product = np.sum([(f[lag:] * f[:-lag]).sum(axis=0) for f in deviations], axis=0)
        correlation = product / np.maximum(power, 1e-300)
        correlated &= correlation > LEAST_CORRELATION
        memory += np.where(correlated, 2.0 * correlation, 0.0)
        if not correlated.any():
            break
    trim = np.full(3, np.inf)
    if len(flights) >= limits.least_flights:
        means = means_of(data.residual, data.flight)
        of_noise = np.mean([scatter**2 * memory / len(f) for f in flights], axis=0)
        trim = np.sqrt(np.maximum(means.var(axis=0, ddof=1) - of_noise, 0.0))
    return Weights(scatter, memory, trim)


def whitened(data: ViewData, weights: Weights) -> tuple[np.ndarray, np.ndarray]:
    """Return residual (M, 3) and slope (M, 3, P) of `data` in units of independent noise."""
    # Standard deviation of independent noise with the same effect as the autocorrelated one.
    unit = weights.scatter * np.sqrt(weights.memory)
    residual, slope = data.residual / unit, data.slope / unit[:, None]
    # Subtract a share of each flight's mean, since its trim is random.
    for number in np.unique(data.flight):
        rows = data.flight == number
        variance = unit**2 / rows.sum()
        share = 1.0 - np.sqrt(variance / (variance + weights.trim**2))
        values = np.concatenate([residual[rows, :, None], slope[rows]], axis=2)
        values -= share[:, None] * values.mean(axis=0)
        if data.pose_slope.any():
            pose_slope = data.pose_slope[rows] / unit[:, None]
            values = less_nuisance(pose_slope - share[:, None] * pose_slope.mean(axis=0), values)
        residual[rows], slope[rows] = values[..., 0], values[..., 1:]
    if weights.base is not None:
        # Subtract a share of the mean of all flights. Where the trim is infinite the share is 0, as
        # the flights' means hold no information.
        variance = unit**2 + weights.trim**2
        share = 1.0 - 1.0 / np.sqrt(1.0 + len(residual) * weights.base**2 / variance)
        residual -= share * residual.mean(axis=0)
        slope -= share[:, None] * slope.mean(axis=0)
    return residual, slope


def block_of(
    data: ViewData, weights: Weights, along: Sequence[int], limits: Thresholds = THRESHOLDS
) -> Block:
    """Return the block of `data`, with slopes `along` parameters."""
    residual, slope = whitened(data, weights)
    # Stretches are so long that they are independent.
    time_block = (data.middle_s / limits.view_block_s).astype(int)
    _, first, stretch = np.unique(
        np.stack([data.flight, time_block]), axis=1, return_index=True, return_inverse=True
    )
    return without_nuisance(
        residual, slope, along, stretch.ravel(), data.flight[first], data.middle_s[first]
    )


def successive_changes(data: ViewData) -> ViewData:
    """Return the changes of all values in `data` from each mean to the next of its flight."""
    step = np.diff(data.middle_s)
    usual_step = np.median(step[step > 0.0])
    neighbours = (np.diff(data.flight) == 0) & (step < 1.5 * usual_step)
    flight, middle_s, *series = data
    changes = (np.diff(one, axis=0)[neighbours] for one in series)
    return ViewData(flight[1:][neighbours], middle_s[1:][neighbours], *changes)


def fast_share(
    data: ViewData, columns: Sequence[int], change: np.ndarray, limits: Thresholds
) -> tuple[float, float]:
    """Return the share of a fitted effect that fast changes confirm, and its 95 % half-width.

    A controller makes the motors compensate a slow torque that the model lacks, so that their
    torque causes no rotation. That looks like a larger inertia or less thrust, but only in slow
    changes. If the model is right, changes from one mean to the next give the same parameters (to
    first order) as the means do (a specification test; Hausman 1978, doi 10.2307/1913827).

    `data` has the effect in the model. `columns` are those of the effect's K parameters in the
    slopes, and `change` (K,) is their fitted value minus that of the vehicle file.
    """
    fast = successive_changes(data)
    fast = fast._replace(slope=(fast.slope[..., list(columns)] @ change)[..., None])
    equations = block_of(fast, weights_of(fast, limits), [0], limits).equations
    hessian, gradient = equations.sums()
    share = 1.0 + float(gradient[0]) / max(float(hessian[0, 0]), 1e-300)
    return share, float(intervals95(equations).half_width[0])


def fast_changes_agree(
    data: ViewData, columns: Sequence[int], change: np.ndarray, limits: Thresholds
) -> bool:
    """Return whether fast changes confirm an effect; the arguments are those of `fast_share`.

    Their share must not be small and significantly less than 1. Means of flights always agree.
    """
    if len(np.unique(data.flight)) == len(data.flight):
        return True
    share, half_width = fast_share(data, columns, change, limits)
    return share >= limits.least_fast_share or share + half_width >= 1.0
