"""Forces that no fitted parameter reproduces: an oscillating one (a swinging load), random wind.

A load on a line causes a narrow peak in the spectrum of the horizontal residual force, at one
period in all flights. Where a model is wrong, the flight's own motion causes peaks as well, but
then the residual force is a small share of the acceleration at that period. Spectra are compared
by their likelihood (Whittle 1953) with and without a peak on a smooth background.

The wind at the knots of a window is normally distributed with the covariance of the effect `gusts`.
Through the drag of the vehicle it adds a covariance to the residuals. Intensity and length maximise
the likelihood of the residuals. The alternative hypothesis is a random disturbance along the body
axes.
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
from eval.quadrotor.plant import Motion, assemble
from eval.quadrotor.stepper import Inputs, PlantState, plant_step
from suite.diagnose.data.view import SmoothedFlight
from suite.diagnose.data.windows import KNOTS
from suite.diagnose.evidence.evidence import flights_agree
from suite.diagnose.evidence.rollout import Flown
from suite.diagnose.evidence.rollouts import RolloutModel
from suite.diagnose.evidence.views import ViewEvidence
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict.residual_structure import DisturbanceEquations

STEP_HZ = 0.01
"""Between the frequencies that are tried [Hz]."""
BAND_HZ = (0.15, 3.0)
"""Of the spectra [Hz]."""
CORNERS_HZ = (0.2, 0.5, 1.2)
"""Of the smooth backgrounds that fall with frequency [Hz]."""
WIDTHS = (0.03, 0.1)
"""Half widths of a peak that are tried, over its frequency [1]."""
HANN_BINS = 1.5
"""Width of a Hann window's line, and its correlation length in bins."""
ROUNDS = 60
"""Of the fits of a spectrum."""


class Swing(NamedTuple):
    """An oscillating force: its period, and a pendulum that would cause it."""

    period_s: float
    ci95: tuple[float, float]
    """Of the period [s]."""
    share: float
    """Share of the residual force's power within `BAND_HZ` [1]."""
    p_value: float
    """After Bonferroni over all periods."""

    @property
    def length_m(self) -> float:
        """Return the length of a pendulum with this period [m], g T^2 / 4 pi^2."""
        return GRAVITY * self.period_s**2 / (4.0 * np.pi**2)

    @property
    def words(self) -> str:
        """Return what oscillates, and what may cause it."""
        low, high = self.ci95
        return (
            f"a force that oscillates with a period of {self.period_s:.2f} s (95 % {low:.2f} to "
            f"{high:.2f}), as a load on a line of {self.length_m:.2g} m causes"
        )


class Spectrum(NamedTuple):
    """Power of one flight by frequency, both horizontal axes together."""

    frequency_hz: np.ndarray
    """(J,)."""
    left: np.ndarray
    """(J,) of the force that is left."""
    moved: np.ndarray
    """(J,) of the measured acceleration."""
    width_hz: float
    """Of a line."""


def swing_left(task: ViewEvidence, theta: np.ndarray) -> Swing | None:
    """Return the oscillation in the residual force of `task` at `theta` (P,); None without one."""
    if not {0, 1} <= set(task.view.axes):
        return None
    data = task.left(theta)
    left_b = [data.residual[data.flight == number] for number in range(len(task.flights))]
    return find_swing(task.flights, left_b, task.limits)


def find_swing(
    flights: Sequence[SmoothedFlight],
    left_b: Sequence[np.ndarray],
    limits: Thresholds = THRESHOLDS,
) -> Swing | None:
    """Return the oscillation in the residual force of `flights`; None where there is none.

    Args:
        flights: of the force view.
        left_b: residual force of each flight, (M, 3) body axes [m/s^2].
        limits: significance and size.
    """
    pairs = zip(flights, left_b, strict=True)
    spectra = [one for flight, left in pairs if (one := _spectrum(flight, left)) is not None]
    if not spectra:
        return None
    longest, shortest = limits.swing_periods_s[1], limits.swing_periods_s[0]
    tried = np.arange(1.0 / longest, 1.0 / shortest + STEP_HZ, STEP_HZ)
    gains, heights = zip(*(_gains(one, tried) for one in spectra), strict=True)
    each = np.array(gains)  # (F, widths, frequencies)
    total = each.sum(axis=0)
    width, at = np.unravel_index(int(total.argmax()), total.shape)
    if not flights_agree(each[:, width, at]):
        return None
    most = float(total[width, at])
    independent = (tried[-1] - tried[0]) / np.mean([one.width_hz for one in spectra])
    chance = float(chi2.sf(2.0 * most, 2 * len(spectra))) * independent * len(WIDTHS)
    centre = float(tried[at])
    driven, share = _about(spectra, centre, [one[width, at] for one in heights])
    if chance > limits.swing_p_value or share < limits.swing_share or driven < limits.swing_driven:
        return None
    near = tried[total[width] >= most - limits.profile_fall]
    near = near[np.abs(near - centre) < 0.5 * centre]
    low, high = near.min() - STEP_HZ, near.max() + STEP_HZ
    return Swing(1.0 / centre, (1.0 / high, 1.0 / low), share, min(chance, 1.0))


def _spectrum(flight: SmoothedFlight, left_b: np.ndarray) -> Spectrum | None:
    """Return the spectrum of one flight; None where it is too short for one."""
    middle = flight.form.middle_s
    if len(middle) < 8:
        return None
    step = float(np.median(np.diff(middle)))
    place = np.round((middle - middle[0]) / step).astype(int)
    count = int(place[-1]) + 1
    if count * step * BAND_HZ[0] < 1.0 or len(middle) < 0.7 * count:
        return None
    rot_w = np.asarray(flight.rows.rot_w)[flight.form.middle_row]
    left_w = (rot_w @ left_b[..., None])[..., 0][:, :2]
    yaw = np.arctan2(rot_w[:, 1, 0], rot_w[:, 0, 0])
    since = np.linspace(-1.0, 1.0, len(middle))
    # A force that turns with the heading, or drifts, is not an oscillation.
    zero, one = np.zeros_like(since), np.ones_like(since)
    steady = np.stack(
        [
            np.stack([one, zero, since, zero, np.cos(yaw), -np.sin(yaw)], axis=1),
            np.stack([zero, one, zero, since, np.sin(yaw), np.cos(yaw)], axis=1),
        ],
        axis=1,
    )
    powers = []
    for series in (left_w, flight.measured[:, :2]):
        columns = steady.reshape(-1, steady.shape[-1])
        fit = np.linalg.lstsq(columns, series.reshape(-1), rcond=None)[0]
        even = np.zeros((count, 2))
        even[place] = series - steady @ fit
        window = np.hanning(count)[:, None]
        lines = np.fft.rfft(even * window, axis=0) / np.sqrt((window**2).sum())
        powers.append((np.abs(lines) ** 2).sum(axis=1))
    frequency = np.fft.rfftfreq(count, step)
    inside = (frequency >= BAND_HZ[0]) & (frequency <= BAND_HZ[1])
    if inside.sum() < 12:
        return None
    left, moved = (power[inside] for power in powers)
    return Spectrum(frequency[inside], left, moved, HANN_BINS / (count * step))


def _gains(one: Spectrum, tried_hz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the gain in log-likelihood by a peak at each frequency, and its height.

    Both are (widths, frequencies).
    """
    frequency = one.frequency_hz
    smooth = [np.ones_like(frequency), frequency**2]
    smooth += [1.0 / (1.0 + (frequency / corner) ** 2) ** 2 for corner in CORNERS_HZ]
    background = np.stack(smooth)
    without, _ = _fitted(one.left, background[None])
    shapes = []
    for width in WIDTHS:
        half = np.hypot(width * tried_hz, 0.5 * one.width_hz)[:, None]
        shapes.append(1.0 / (1.0 + ((frequency - tried_hz[:, None]) / half) ** 2) ** 2)
    peaks = np.concatenate(shapes)[:, None]
    whole = np.concatenate([np.broadcast_to(background, (len(peaks), *background.shape)), peaks], 1)
    with_it, weights = _fitted(one.left, whole)
    shape = (len(WIDTHS), len(tried_hz))
    return (with_it - without).reshape(shape), weights[:, -1].reshape(shape)


def _fitted(power: np.ndarray, shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the log-likelihood (C,) of sums of `shapes` (C, T, J), and their weights (C, T).

    Power (J,) of two axes is chi-square distributed about its mean; the weights are found by
    multiplicative updates (Itakura-Saito distance; Fevotte, Bertin and Durrieu 2009).
    """
    scale = shapes.mean(axis=2, keepdims=True)
    unit = shapes / scale
    weights = np.full(unit.shape[:2], float(power.mean()) / unit.shape[1])
    for _ in range(ROUNDS):
        model = np.einsum("ct,ctj->cj", weights, unit)
        up = np.einsum("ctj,cj->ct", unit, power / model**2)
        weights = weights * np.sqrt(up / np.einsum("ctj,cj->ct", unit, 1.0 / model))
    model = np.einsum("ct,ctj->cj", weights, unit)
    likelihood = -(2.0 / HANN_BINS) * (np.log(model) + power / model).sum(axis=1)
    return likelihood, weights / scale[..., 0]


def _about(
    spectra: Sequence[Spectrum], centre_hz: float, heights: Sequence[float]
) -> tuple[float, float]:
    """Return the ratio of residual force to acceleration at a frequency, and the peak's share."""
    left = moved = peak = whole = 0.0
    for one, height in zip(spectra, heights, strict=True):
        inside = np.abs(one.frequency_hz - centre_hz) <= one.width_hz
        left += float(one.left[inside].sum())
        moved += float(one.moved[inside].sum())
        peak += float(np.minimum(height, one.left[inside]).sum())
        whole += float(one.left.sum())
    return float(np.sqrt(left / max(moved, 1e-12))), peak / max(whole, 1e-12)


class Turbulence(NamedTuple):
    """Random wind that was found."""

    intensity: float
    """[m/s]."""
    intensity_ci95: tuple[float, float]
    length: float
    """[m]."""
    length_ci95: tuple[float, float]
    ratio: float
    """Log-likelihood over that of no wind."""

    @property
    def effect(self) -> str:
        """Name of the wind in the catalogue."""
        return GUSTS.name

    @property
    def values(self) -> Gusts:
        """What a vehicle file holds of it."""
        return Gusts(self.intensity, self.length)


def find_turbulence(
    model: RolloutModel,
    theta: np.ndarray,
    disturbance: DisturbanceEquations,
    limits: Thresholds = THRESHOLDS,
) -> Turbulence | None:
    """Return the random wind that explains the residual of `model` at `theta` (P,), or None."""
    passed = _passed_on(model, theta, disturbance.knot)
    if np.abs(passed).max() < 1e-6:
        return None
    tried_m, tried = np.geomspace(*limits.wind_lengths_m), np.geomspace(*limits.wind_intensities)
    roots = [passed @ _wind_root(disturbance.knot, length) for length in tried_m]
    table = np.stack([_likelihood(disturbance, root, tried) for root in roots])
    i, j = np.unravel_index(int(table.argmax()), table.shape)
    ratio = float(table[i, j])
    if ratio < limits.wind_ratio or _free_likelihood(disturbance) > ratio + limits.wind_rival_ratio:
        return None
    if _has_outliers(disturbance, roots[i], tried[j], limits.wind_tail):
        return None
    near = table >= ratio - limits.profile_fall
    lengths, intensities = tried_m[near.any(axis=1)], tried[near.any(axis=0)]
    return Turbulence(
        float(tried[j]),
        (float(intensities[0]), float(intensities[-1])),
        float(tried_m[i]),
        (float(lengths[0]), float(lengths[-1])),
        ratio,
    )


def _passed_on(model: RolloutModel, theta: np.ndarray, knot: Flown) -> np.ndarray:
    """Return (W, 6 KNOTS, 3 KNOTS): the push per m/s of wind in the world at each knot."""
    given = model.given
    values = {n: v for n, v in model.space.effects(theta).items() if EFFECTS[n].by_state}
    steady_wind = CONSTANT_WIND.name
    plain = np.asarray(values[steady_wind].velocity)
    motion = Motion(*(np.asarray(field) for field in knot.track))
    count = len(motion.pos_w)
    state = PlantState(np.asarray(knot.rotor_speed), np.zeros(0), {})
    still = np.zeros(motion.pos_w.shape[:2])
    inputs = Inputs(rotor_speed=np.asarray(knot.rotor_speed), voltage_drop=still)

    def wrench(wind_w: np.ndarray) -> np.ndarray:
        values[steady_wind] = ConstantWind(plain + wind_w)
        plant = assemble(given.nominal, given.constants, values, model.dt, 0.0)
        _, out = plant_step(plant, state, motion, inputs, still)
        mass, inertia = plant.constants.mass, plant.constants.inertia
        return np.concatenate([out.force_b / mass, out.torque_b / inertia], axis=-1)

    slopes = [0.5 * (wrench(axis) - wrench(-axis)) for axis in np.eye(3)]
    passed = np.zeros((count, KNOTS, 6, KNOTS, 3))
    for k in range(KNOTS):
        passed[:, k, :, k, :] = np.stack([slope[:, k] for slope in slopes], axis=-1)
    return passed.reshape(count, KNOTS * 6, KNOTS * 3)


def _wind_root(knot: Flown, length_m: float) -> np.ndarray:
    """Return a root (W, 3 KNOTS, 3 KNOTS) of the wind's covariance for an intensity of 1 m/s."""
    speed = np.maximum(np.sqrt((np.asarray(knot.track.vel_w) ** 2).sum(axis=-1)), 1.0)
    step = 0.5 * (speed[:, 1:] + speed[:, :-1]) / (KNOTS - 1) / length_m
    passed = np.concatenate([np.zeros((len(speed), 1)), np.cumsum(step, axis=1)], axis=1)
    colour = np.exp(-np.abs(passed[:, :, None] - passed[:, None, :]))
    root = np.linalg.cholesky(colour + 1e-9 * np.eye(KNOTS))
    axes = np.diag([1.0, 1.0, VERTICAL])
    count = len(root)
    whole = np.einsum("wkl,ab->wkalb", root, axes)
    return whole.reshape(count, KNOTS * 3, KNOTS * 3)


def _pulls(equations: DisturbanceEquations, root: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return information and gradient (W, J) along independent directions of root @ normal."""
    turned = np.swapaxes(root, 1, 2)
    values, vectors = np.linalg.eigh(turned @ equations.hessian @ root)
    pulls = np.swapaxes(vectors, 1, 2) @ (turned @ equations.gradient[..., None])
    return values, pulls[..., 0]


def _likelihood(equations: DisturbanceEquations, root: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return the log-likelihood ratio of disturbances root @ normal to none, for `sizes`."""
    values, pulls = _pulls(equations, root)
    values = np.maximum(values, 0.0)
    raised = sizes[:, None, None] ** 2
    terms = raised * pulls**2 / (1.0 + raised * values) - np.log1p(raised * values)
    return 0.5 * terms.sum(axis=(1, 2))


def _has_outliers(
    equations: DisturbanceEquations, root: np.ndarray, size: float, tail: float
) -> bool:
    """Return whether the disturbance has heavier tails than a normal wind.

    The fourth power of a normal variable of variance 1 has mean 3 and variance 96; the measured
    mean may exceed 3 by `tail` standard errors. A force at some places or speeds only has a higher
    one.
    """
    values, pulls = _pulls(equations, root)
    heard = size**2 * values > 1.0
    if heard.sum() < 8:
        return False
    power = pulls[heard] ** 2 / values[heard] / (1.0 + size**2 * values[heard])
    fourth = float((power**2).mean() / power.mean() ** 2)
    return fourth > 3.0 + tail * np.sqrt(96.0 / heard.sum())


def _free_likelihood(equations: DisturbanceEquations) -> float:
    """Return the largest log-likelihood of a random disturbance with a size for each body axis."""
    time = np.linspace(0.0, 1.0, KNOTS)

    def loss(logs: np.ndarray) -> float:
        sizes, tau = np.exp(logs[:6]), np.exp(logs[6])
        colour = np.exp(-np.abs(time[:, None] - time) / tau) + 1e-9 * np.eye(KNOTS)
        root = np.einsum("kl,ab->kalb", np.linalg.cholesky(colour), np.diag(sizes))
        root = root.reshape(1, KNOTS * 6, KNOTS * 6).repeat(len(equations.gradient), axis=0)
        return -float(_likelihood(equations, root, np.ones(1))[0])

    begin = np.log([0.05, 0.05, 0.05, 0.01, 0.01, 0.01, 0.5])
    bounds = [(-9.0, 3.0)] * 6 + [(np.log(0.05), np.log(5.0))]
    found = minimize(loss, begin, method="Powell", bounds=bounds, options={"maxiter": 4})
    return -float(found.fun)
