"""Random wind: a push that no rollout repeats, known by its colour and by how drag passes it on.

The wind at the knots of a window is a normal variable with the covariance of `gusts`; through the
drag of the vehicle it adds a covariance to the residuals. Intensity and length are where the
likelihood of the residuals is largest. Whether it is wind is asked by a rival that may push along
the body axes as it likes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from eval.effects.constant_wind import ConstantWind
from eval.effects.gusts import VERTICAL
from eval.quadrotor.plant import Motion, assemble
from eval.quadrotor.stepper import Inputs, PlantState, plant_step
from suite.diagnose.fit.model import Model
from suite.diagnose.fit.rollout import KNOTS, Flown
from suite.diagnose.verdict.residual_structure import Push

LENGTHS_M = np.geomspace(0.5, 40.0, 25)
"""Lengths that are tried [m]."""
INTENSITIES = np.geomspace(0.02, 8.0, 121)
"""Intensities that are tried [m/s]."""
SURE = 10.0
"""Log-likelihood ratio to no wind from which there is wind."""
RIVAL = 8.0
"""A push along the body axes that is better by this log-likelihood is no wind."""
TAIL = 4.0
"""Standard errors by which the tails of the pulls may be above those of a normal variable."""
WITHIN = 1.92
"""Fall of the log-likelihood at the ends of a 95 % interval (Wilks 1938)."""


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


def find_turbulence(model: Model, theta: np.ndarray, push: Push) -> Turbulence | None:
    """Return the random wind that explains what `push` leaves over, or None.

    Args:
        model: of the windows.
        theta: (P,) its numbers.
        push: what a further push does to the windows of `model` at `theta`.
    """
    passed = _passed_on(model, theta, push.knot)
    if np.abs(passed).max() < 1e-6:
        return None
    table = np.full((len(LENGTHS_M), len(INTENSITIES)), -np.inf)
    for i, length in enumerate(LENGTHS_M):
        root = passed @ _wind_root(push.knot, length)
        table[i] = _likelihood(push, root, INTENSITIES)
    i, j = np.unravel_index(int(table.argmax()), table.shape)
    ratio = float(table[i, j])
    if ratio < SURE or _free_push(push) > ratio + RIVAL:
        return None
    if _outliers(push, passed @ _wind_root(push.knot, float(LENGTHS_M[i])), INTENSITIES[j]):
        return None
    near = table >= ratio - WITHIN
    lengths, intensities = LENGTHS_M[near.any(axis=1)], INTENSITIES[near.any(axis=0)]
    return Turbulence(
        float(INTENSITIES[j]),
        (float(intensities[0]), float(intensities[-1])),
        float(LENGTHS_M[i]),
        (float(lengths[0]), float(lengths[-1])),
        ratio,
    )


def _passed_on(model: Model, theta: np.ndarray, knot: Flown) -> np.ndarray:
    """Return (W, 6 KNOTS, 3 KNOTS): the push per m/s of wind in the world at each knot."""
    given = model.given
    values = dict(model.space.effects(theta))
    values.pop("gusts", None)
    plain = np.asarray(values["constant_wind"].velocity)
    motion = Motion(*(np.asarray(field) for field in knot.track))
    count = len(motion.pos_w)
    state = PlantState(np.zeros(0), np.zeros(0), {})
    still = np.zeros(motion.pos_w.shape[:2])
    inputs = Inputs(rotor_speed=np.asarray(knot.rotor_speed), voltage_drop=still)

    def wrench(wind_w: np.ndarray) -> np.ndarray:
        values["constant_wind"] = ConstantWind(plain + wind_w)
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


def _likelihood(push: Push, root: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return the log-likelihood over that of none of pushes root @ normal draws, for `sizes`."""
    turned = np.swapaxes(root, 1, 2)
    values, vectors = np.linalg.eigh(turned @ push.square @ root)
    values = np.maximum(values, 0.0)
    pulls = (np.swapaxes(vectors, 1, 2) @ (turned @ push.cross[..., None]))[..., 0]
    raised = sizes[:, None, None] ** 2
    terms = raised * pulls**2 / (1.0 + raised * values) - np.log1p(raised * values)
    return 0.5 * terms.sum(axis=(1, 2))


def _outliers(push: Push, root: np.ndarray, size: float) -> bool:
    """Return whether the pulls are larger now and then than those of a normal wind.

    Their fourth power has mean 3 and variance 96 over their variance. What comes only in some
    places, or at some speeds, has more of it than wind has.
    """
    turned = np.swapaxes(root, 1, 2)
    values, vectors = np.linalg.eigh(turned @ push.square @ root)
    pulls = (np.swapaxes(vectors, 1, 2) @ (turned @ push.cross[..., None]))[..., 0]
    heard = size**2 * values > 1.0
    if heard.sum() < 8:
        return False
    power = pulls[heard] ** 2 / values[heard] / (1.0 + size**2 * values[heard])
    fourth = float((power**2).mean() / power.mean() ** 2)
    return fourth > 3.0 + TAIL * np.sqrt(96.0 / heard.sum())


def _free_push(push: Push) -> float:
    """Return the largest log-likelihood of a random push with a size for each body axis."""
    time = np.linspace(0.0, 1.0, KNOTS)

    def worse(logs: np.ndarray) -> float:
        sizes, tau = np.exp(logs[:6]), np.exp(logs[6])
        colour = np.exp(-np.abs(time[:, None] - time) / tau) + 1e-9 * np.eye(KNOTS)
        root = np.einsum("kl,ab->kalb", np.linalg.cholesky(colour), np.diag(sizes))
        root = root.reshape(1, KNOTS * 6, KNOTS * 6).repeat(len(push.cross), axis=0)
        return -float(_likelihood(push, root, np.ones(1))[0])

    begin = np.log([0.05, 0.05, 0.05, 0.01, 0.01, 0.01, 0.5])
    bounds = [(-9.0, 3.0)] * 6 + [(np.log(0.05), np.log(5.0))]
    found = minimize(worse, begin, method="Powell", bounds=bounds, options={"maxiter": 4})
    return -float(found.fun)
