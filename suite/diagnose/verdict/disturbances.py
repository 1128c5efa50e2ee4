"""Detects forces that no fitted parameter reproduces: a swinging load and random wind.

A load on a line swings. It causes a narrow peak in the spectrum of the horizontal residual force
(measured minus simulated), at one period in all flights. A wrong model also causes peaks, at the
periods of the vehicle's own motion, but there the residual force is a small share of the
acceleration. So the test compares the likelihood of each spectrum (Whittle 1953) with a peak on a
smooth background and without.

Random wind is normally distributed with the covariance of the effect `gusts`. It acts through the
drag of the vehicle and makes the errors of rollouts (simulated 1 s windows) correlated. The wind is
represented at the knots (support points in time) of each window. Its intensity and length scale
maximise the likelihood. The competing hypothesis is any random force along the body axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.stats import chi2

from eval.effects import EFFECTS
from eval.effects.interface import GRAVITY
from eval.effects.wind import CONSTANT_WIND, GUSTS, VERTICAL, ConstantWind, Gusts
from eval.quadrotor.continuous import Flight
from eval.quadrotor.plant import Motion, assemble
from eval.quadrotor.stepper import Inputs, PlantState, plant_step
from suite.diagnose.data.view import SmoothedFlight
from suite.diagnose.data.windows import KNOTS
from suite.diagnose.evidence.evidence import flights_agree
from suite.diagnose.evidence.rollouts import RolloutModel
from suite.diagnose.evidence.views import ViewEvidence
from suite.diagnose.verdict.actuators import LEAST_P, TestedEffect
from suite.diagnose.verdict.residual_structure import DisturbanceEquations, diagonalised

STEP_HZ = 0.01
"""Step between the tested frequencies [Hz]."""
BAND_HZ = (0.15, 3.0)
"""Frequency band of the spectra [Hz]."""
WIDTHS = (0.03, 0.1)
"""Tested half widths of a peak, as shares of its frequency."""
HANN_BINS = 1.5
"""Width of a spectral line after a Hann window, and of the correlation of bins [frequency bins]."""
LEAST_MEANS, LEAST_FILLED, LEAST_FREQUENCIES = 8, 0.7, 12
"""For a spectrum: fewest means of the view, least share of times with one, fewest frequencies."""
UPDATES = 60
"""Number of updates of the weights in the fit of a spectrum."""


class Swing(NamedTuple):
    """An oscillating force: its period, and a pendulum that would cause it."""

    period_s: float
    ci95: tuple[float, float]
    """95 % interval of the period [s]."""

    @property
    def length_m(self) -> float:
        """Length of a pendulum with this period [m], g T^2 / 4 pi^2."""
        return GRAVITY * self.period_s**2 / (4.0 * np.pi**2)

    @property
    def words(self) -> str:
        """Description of the force and of a possible cause, for people."""
        low, high = self.ci95
        return (
            f"a force that oscillates with a period of {self.period_s:.2f} s (95 % {low:.2f} to "
            f"{high:.2f}), as a load on a line of {self.length_m:.2g} m causes"
        )


class Spectrum(NamedTuple):
    """Power of one flight at J frequencies, both horizontal axes together."""

    frequency_hz: np.ndarray
    """(J,) frequencies [Hz]."""
    residual: np.ndarray
    """(J,) power of the residual force."""
    measured: np.ndarray
    """(J,) power of the measured acceleration."""
    width_hz: float
    """Width of a spectral line [Hz]."""


def residual_swing(task: ViewEvidence, theta: np.ndarray) -> Swing | None:
    """Return the oscillation in the residual force of `task` at `theta` (P,), if there is one."""
    if not {0, 1} <= set(task.view.axes):
        return None
    data, limits = task.residuals(theta), task.limits
    residuals = (data.residual[data.flight == k] for k in range(len(task.flights)))
    spectra = [one for one in map(_spectrum, task.flights, residuals) if one is not None]
    if not spectra:
        return None
    shortest_s, longest_s = 0.6, 3.5  # periods of pendulums of 0.1 to 3 m
    frequency_hz = np.arange(1.0 / longest_s, 1.0 / shortest_s + STEP_HZ, STEP_HZ)
    gains, heights = zip(*(_peak_gains(s, frequency_hz) for s in spectra), strict=True)
    flight_gain = np.array(gains)  # (F, widths, frequencies)
    gain = flight_gain.sum(axis=0)
    width, best = np.unravel_index(int(gain.argmax()), gain.shape)
    if not flights_agree(flight_gain[:, width, best]):
        return None
    largest = float(gain[width, best])
    independent = (frequency_hz[-1] - frequency_hz[0]) / np.mean([s.width_hz for s in spectra])
    # Bonferroni's correction for all tested periods and widths.
    p_value = float(chi2.sf(2.0 * largest, 2 * len(spectra))) * independent * len(WIDTHS)
    # Reject a peak that is not significant, small, or small next to the acceleration there.
    centre_hz = float(frequency_hz[best])
    force_ratio, share = _peak_shares(spectra, centre_hz, [one[width, best] for one in heights])
    is_small = share < limits.swing_share or force_ratio < limits.swing_driven
    if p_value > limits.swing_p_value or is_small:
        return None
    # 95 % interval by the profile likelihood.
    likely = frequency_hz[gain[width] >= largest - limits.profile_fall]
    likely = likely[np.abs(likely - centre_hz) < 0.5 * centre_hz]
    low, high = likely.min() - STEP_HZ, likely.max() + STEP_HZ
    return Swing(1.0 / centre_hz, (1.0 / high, 1.0 / low))


def _spectrum(flight: SmoothedFlight, residual_b: np.ndarray) -> Spectrum | None:
    """Return the spectrum of `residual_b` (M, 3) [m/s^2]; None if too short, or with many holes."""
    middle_s = flight.form.middle_s
    if len(middle_s) < LEAST_MEANS:
        return None
    step_s = float(np.median(np.diff(middle_s)))
    grid_index = np.round((middle_s - middle_s[0]) / step_s).astype(int)
    grid_size = int(grid_index[-1]) + 1
    if grid_size * step_s * BAND_HZ[0] < 1.0 or len(middle_s) < LEAST_FILLED * grid_size:
        return None
    rot_w = np.asarray(flight.rows.motion.rot_w)[flight.form.middle_row]
    residual_w = (rot_w @ residual_b[..., None])[..., 0][:, :2]
    yaw = np.arctan2(rot_w[:, 1, 0], rot_w[:, 0, 0])
    time = np.linspace(-1.0, 1.0, len(middle_s))
    # Subtracted first: forces that are constant, drift, or turn with the heading do not oscillate.
    zero, one = np.zeros_like(time), np.ones_like(time)
    along_x = np.stack([one, zero, time, zero, np.cos(yaw), -np.sin(yaw)], axis=1)
    along_y = np.stack([zero, one, zero, time, np.sin(yaw), np.cos(yaw)], axis=1)
    trend = np.stack([along_x, along_y], axis=1)
    trend_columns = trend.reshape(-1, trend.shape[-1])
    window = np.hanning(grid_size)[:, None]
    powers = []
    for series in (residual_w, flight.measured[:, :2]):
        trend_weights = np.linalg.lstsq(trend_columns, series.reshape(-1), rcond=None)[0]
        detrended = np.zeros((grid_size, 2))
        detrended[grid_index] = series - trend @ trend_weights
        transform = np.fft.rfft(detrended * window, axis=0) / np.sqrt((window**2).sum())
        powers.append((np.abs(transform) ** 2).sum(axis=1))
    frequency_hz = np.fft.rfftfreq(grid_size, step_s)
    in_band = (frequency_hz >= BAND_HZ[0]) & (frequency_hz <= BAND_HZ[1])
    if in_band.sum() < LEAST_FREQUENCIES:
        return None
    residual, measured = (power[in_band] for power in powers)
    return Spectrum(frequency_hz[in_band], residual, measured, HANN_BINS / (grid_size * step_s))


def _peak_gains(spectrum: Spectrum, centre_hz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return gains in log-likelihood by peaks, and their heights, (widths, `centre_hz`) each."""
    frequency = spectrum.frequency_hz
    # The smooth background falls above one of these corner frequencies.
    falling = (1.0 / (1.0 + (frequency / corner_hz) ** 2) ** 2 for corner_hz in (0.2, 0.5, 1.2))
    background = np.stack([np.ones_like(frequency), frequency**2, *falling])
    without, _ = _fit_spectrum(spectrum.residual, background[None])
    shapes = []
    for width in WIDTHS:
        half_hz = np.hypot(width * centre_hz, 0.5 * spectrum.width_hz)[:, None]
        shapes.append(1.0 / (1.0 + ((frequency - centre_hz[:, None]) / half_hz) ** 2) ** 2)
    peaks = np.concatenate(shapes)[:, None]
    backgrounds = np.broadcast_to(background, (len(peaks), *background.shape))
    every = np.concatenate([backgrounds, peaks], axis=1)
    with_peak, weights = _fit_spectrum(spectrum.residual, every)
    shape = (len(WIDTHS), len(centre_hz))
    return (with_peak - without).reshape(shape), weights[:, -1].reshape(shape)


def _fit_spectrum(power: np.ndarray, shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the log-likelihood (C,) of sums of `shapes` (C, T, J), and their weights (C, T).

    Power (J,) of two axes is chi-square distributed about its mean; the weights are found by
    multiplicative updates (Itakura-Saito distance; Fevotte, Bertin and Durrieu 2009).
    """
    scale = shapes.mean(axis=2, keepdims=True)
    unit_shapes = shapes / scale
    weights = np.full(unit_shapes.shape[:2], float(power.mean()) / unit_shapes.shape[1])
    for _ in range(UPDATES):
        model = np.einsum("ct,ctj->cj", weights, unit_shapes)
        numerator = np.einsum("ctj,cj->ct", unit_shapes, power / model**2)
        weights = weights * np.sqrt(numerator / np.einsum("ctj,cj->ct", unit_shapes, 1.0 / model))
    model = np.einsum("ct,ctj->cj", weights, unit_shapes)
    likelihood = -(2.0 / HANN_BINS) * (np.log(model) + power / model).sum(axis=1)
    return likelihood, weights / scale[..., 0]


def _peak_shares(
    spectra: Sequence[Spectrum], centre_hz: float, heights: Sequence[float]
) -> tuple[float, float]:
    """Return the residual force over the acceleration at a peak, and its share of the power."""
    residual = measured = peak = total = 0.0
    for spectrum, height in zip(spectra, heights, strict=True):
        in_peak = np.abs(spectrum.frequency_hz - centre_hz) <= spectrum.width_hz
        residual += float(spectrum.residual[in_peak].sum())
        measured += float(spectrum.measured[in_peak].sum())
        peak += float(np.minimum(height, spectrum.residual[in_peak]).sum())
        total += float(spectrum.residual.sum())
    return float(np.sqrt(residual / max(measured, 1e-12))), peak / max(total, 1e-12)


def find_turbulence(
    model: RolloutModel, theta: np.ndarray, disturbance: DisturbanceEquations
) -> tuple[TestedEffect, float] | None:
    """Return the random wind that explains the residual, and its log-likelihood over none; or None.

    None also without a drag that transmits it, with a better random force, or by outliers alone.
    """
    transmission, limits = _wind_transmission(model, theta, disturbance.knot), disturbance.limits
    if np.abs(transmission).max() < 1e-6:
        return None
    # Length scales [m] and intensities [m/s] of the turbulence that are tried.
    lengths_m, intensities = np.geomspace(0.5, 40.0, 25), np.geomspace(0.02, 8.0, 121)
    roots = [transmission @ _wind_root(disturbance.knot, length) for length in lengths_m]
    table = np.stack([_likelihood(disturbance, root, intensities) for root in roots])
    i, j = np.unravel_index(int(table.argmax()), table.shape)
    ratio = float(table[i, j])
    if ratio < limits.wind_ratio or _free_likelihood(disturbance) > ratio + limits.wind_rival_ratio:
        return None
    if _has_outliers(disturbance, roots[i], intensities[j], limits.wind_tail):
        return None
    likely = table >= ratio - limits.profile_fall  # 95 % by the profile likelihood
    intensity, length = float(intensities[j]), float(lengths_m[i])
    parameters = {
        name: {"value": value, "unit": unit, "ci95": _range_of(tried, np.asarray(of))}
        for name, value, unit, tried, of in (
            ("intensity", intensity, "m/s", intensities, likely.any(axis=0)),
            ("length", length, "m", lengths_m, likely.any(axis=1)),
        )
    }
    values, p_value = Gusts(intensity, length), max(float(np.exp(-ratio)), LEAST_P)
    return TestedEffect(GUSTS.name, values, parameters, None, p_value, "whole"), ratio


def _range_of(tried: np.ndarray, is_likely: np.ndarray) -> list[float] | None:
    """Return the least and the largest likely value of those `tried`; None at the end of these."""
    if is_likely[0] or is_likely[-1]:
        return None
    return [float(tried[is_likely][0]), float(tried[is_likely][-1])]


def _wind_transmission(model: RolloutModel, theta: np.ndarray, knot: Flight) -> np.ndarray:
    """Return the accelerations per m/s of wind along world axes, (W, 6 KNOTS, 3 KNOTS)."""
    given = model.given
    values = {n: v for n, v in model.space.effects(theta).items() if EFFECTS[n].by_state}
    steady_w = np.asarray(values[CONSTANT_WIND.name].velocity)
    motion = Motion(*(np.asarray(field) for field in knot.motion))
    count = len(motion.pos_w)
    state = PlantState(np.asarray(knot.rotor_speed), np.zeros(0), {})
    zeros = np.zeros(motion.pos_w.shape[:2])
    inputs = Inputs(rotor_speed=np.asarray(knot.rotor_speed), voltage_drop=zeros)

    def accelerations(wind_w: np.ndarray) -> np.ndarray:
        values[CONSTANT_WIND.name] = ConstantWind(steady_w + wind_w)
        plant = assemble(given.nominal, given.constants, values, model.dt, 0.0)
        _, out = plant_step(plant, state, motion, inputs, zeros)
        mass, inertia = plant.constants.mass, plant.constants.inertia
        return np.concatenate([out.force_b / mass, out.torque_b / inertia], axis=-1)

    slopes = [0.5 * (accelerations(axis) - accelerations(-axis)) for axis in np.eye(3)]
    transmission = np.zeros((count, KNOTS, 6, KNOTS, 3))
    for k in range(KNOTS):
        transmission[:, k, :, k, :] = np.stack([slope[:, k] for slope in slopes], axis=-1)
    return transmission.reshape(count, KNOTS * 6, KNOTS * 3)


def _wind_root(knot: Flight, length_m: float) -> np.ndarray:
    """Return a root (W, 3 KNOTS, 3 KNOTS) of the covariance of a wind of intensity 1 m/s.

    The correlation decays exponentially with the distance flown over the length scale `length_m`.
    """
    speed = np.maximum(np.sqrt((np.asarray(knot.motion.vel_w) ** 2).sum(axis=-1)), 1.0)
    step = 0.5 * (speed[:, 1:] + speed[:, :-1]) / (KNOTS - 1) / length_m
    distance = np.concatenate([np.zeros((len(speed), 1)), np.cumsum(step, axis=1)], axis=1)
    correlation = np.exp(-np.abs(distance[:, :, None] - distance[:, None, :]))
    root = np.linalg.cholesky(correlation + 1e-9 * np.eye(KNOTS))
    return np.kron(root, np.diag([1.0, 1.0, VERTICAL]))


def _likelihood(equations: DisturbanceEquations, root: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return log-likelihood ratios of disturbances size * root @ z (z normal) to none, by size."""
    information, gradient = diagonalised(equations.hessian, equations.gradient, root)
    information = np.maximum(information, 0.0)
    variance = sizes[:, None, None] ** 2
    terms = variance * gradient**2 / (1.0 + variance * information)
    terms = terms - np.log1p(variance * information)
    return 0.5 * terms.sum(axis=(1, 2))


def _has_outliers(
    equations: DisturbanceEquations, root: np.ndarray, size: float, tail: float
) -> bool:
    """Return whether the disturbance has heavier tails than a normal wind of this `size`.

    The fourth power of a normal variable of variance 1 has mean 3 and variance 96; the measured
    mean may exceed 3 by `tail` standard errors. A force at some places or speeds has a higher one.
    With fewer than eight directions that contain information the result is False.
    """
    information, gradient = diagonalised(equations.hessian, equations.gradient, root)
    informed = size**2 * information > 1.0
    if informed.sum() < 8:
        return False
    information, gradient = information[informed], gradient[informed]
    power = gradient**2 / information / (1.0 + size**2 * information)
    fourth = float((power**2).mean() / power.mean() ** 2)
    return fourth > 3.0 + tail * np.sqrt(96.0 / informed.sum())


def _free_likelihood(equations: DisturbanceEquations) -> float:
    """Return the largest log-likelihood ratio of a random disturbance along the body axes."""
    time = np.linspace(0.0, 1.0, KNOTS)

    def loss(logs: np.ndarray) -> float:  # of a size for each axis, and of a correlation time
        sizes, tau_s = np.exp(logs[:6]), np.exp(logs[6])
        correlation = np.exp(-np.abs(time[:, None] - time) / tau_s) + 1e-9 * np.eye(KNOTS)
        root = np.kron(np.linalg.cholesky(correlation), np.diag(sizes))
        return -float(_likelihood(equations, root, np.ones(1))[0])

    start = np.log([0.05, 0.05, 0.05, 0.01, 0.01, 0.01, 0.5])
    bounds = [(-9.0, 3.0)] * 6 + [(np.log(0.05), np.log(5.0))]
    best = minimize(loss, start, method="Powell", bounds=bounds, options={"maxiter": 4})
    return -float(best.fun)
