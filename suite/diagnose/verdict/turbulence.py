"""Random wind: no rollout repeats it; known by its colour and by how drag passes it on.

The wind at the knots of a window is a normal variable with the covariance of `gusts`; through the
drag of the vehicle it adds a covariance to the residuals. Intensity and length are where the
likelihood of the residuals is largest. Whether it is wind is asked by a rival that may push along
the body axes as it likes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from eval.effects import EFFECTS, constant_wind, gusts
from eval.quadrotor.plant import Motion, assemble
from eval.quadrotor.stepper import Inputs, PlantState, plant_step
from suite.diagnose.data.windows import KNOTS
from suite.diagnose.evidence.rollout import Flown
from suite.diagnose.evidence.rollout_model import RolloutModel
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict.residual_structure import DisturbanceEquations


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
        return gusts.EFFECT.name

    @property
    def values(self) -> gusts.Gusts:
        """What a vehicle file holds of it."""
        return gusts.Gusts(self.intensity, self.length)


def find_turbulence(
    model: RolloutModel,
    theta: np.ndarray,
    disturbance: DisturbanceEquations,
    limits: Thresholds = THRESHOLDS,
) -> Turbulence | None:
    """Return the random wind that explains what `model` leaves over at `theta` (P,), or None."""
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
    steady_wind = constant_wind.EFFECT.name
    plain = np.asarray(values[steady_wind].velocity)
    motion = Motion(*(np.asarray(field) for field in knot.track))
    count = len(motion.pos_w)
    state = PlantState(np.asarray(knot.rotor_speed), np.zeros(0), {})
    still = np.zeros(motion.pos_w.shape[:2])
    inputs = Inputs(rotor_speed=np.asarray(knot.rotor_speed), voltage_drop=still)

    def wrench(wind_w: np.ndarray) -> np.ndarray:
        values[steady_wind] = constant_wind.ConstantWind(plain + wind_w)
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
    axes = np.diag([1.0, 1.0, gusts.VERTICAL])
    count = len(root)
    whole = np.einsum("wkl,ab->wkalb", root, axes)
    return whole.reshape(count, KNOTS * 3, KNOTS * 3)


def _pulls(equations: DisturbanceEquations, root: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return information (W, J) and pull (W, J) along what disturbances root @ normal do apart."""
    turned = np.swapaxes(root, 1, 2)
    values, vectors = np.linalg.eigh(turned @ equations.hessian @ root)
    pulls = np.swapaxes(vectors, 1, 2) @ (turned @ equations.gradient[..., None])
    return values, pulls[..., 0]


def _likelihood(equations: DisturbanceEquations, root: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return the log-likelihood over that of none of disturbances root @ normal, for `sizes`."""
    values, pulls = _pulls(equations, root)
    values = np.maximum(values, 0.0)
    raised = sizes[:, None, None] ** 2
    terms = raised * pulls**2 / (1.0 + raised * values) - np.log1p(raised * values)
    return 0.5 * terms.sum(axis=(1, 2))


def _has_outliers(
    equations: DisturbanceEquations, root: np.ndarray, size: float, tail: float
) -> bool:
    """Return whether the pulls are larger now and then than those of a normal wind.

    Their fourth power has mean 3 and variance 96 over their variance; `tail` is how many standard
    errors it may be above. What comes only in some places, or at some speeds, has more of it than
    wind has.
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
