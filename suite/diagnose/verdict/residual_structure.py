"""Tests rollout residuals for structure: a force or torque that depends on the state.

A residual is the error that remains after a fit. What the model lacks is represented by a
disturbance: an additional force and torque, piecewise linear in time between the knots (support
points) of every 1 s window. Both tests work without the catalogue of effects. The first one fits
shapes, which are simple functions of the state such as the square of the speed, and tests whether a
shape lowers the error on left-out windows. The second one tests whether the disturbance has more
energy than noise gives (a score test of a smooth random disturbance).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import gamma

from eval.effects.interface import GRAVITY
from eval.quadrotor.continuous import Flight
from suite.diagnose.data.whitening import block_of
from suite.diagnose.data.windows import KNOTS, FlightWindows
from suite.diagnose.estimate.block import Estimate
from suite.diagnose.estimate.gauss_newton import Z95
from suite.diagnose.estimate.parameters import Candidate
from suite.diagnose.estimate.permutation import CandidateScore, permutation_test
from suite.diagnose.evidence.rollouts import RolloutEvidence
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict.gap import EffectSize, beyond_error, less_error

AXES = ("force x", "force y", "force z", "torque x", "torque y", "torque z")


class DisturbanceEquations(NamedTuple):
    """Normal equations of a disturbance at the knots of W windows.

    J is the derivative of the whitened residuals r by three forces and three torques at each knot.
    """

    hessian: np.ndarray
    """(W, 6 KNOTS, 6 KNOTS) J'J, the information on the disturbance."""
    gradient: np.ndarray
    """(W, 6 KNOTS) J'r."""
    knot: Flight
    """(W, KNOTS, ...) simulated state at the knots."""
    unit: np.ndarray
    """(W, 6 KNOTS, J) linear [m/s^2] and angular [rad/s^2] acceleration in body axes that each of
    the J columns of all shapes gives with a coefficient of 1."""
    shapes: Sequence[Candidate]
    """The shapes, with labels such as "force with the speed". Their indices are the columns."""
    limits: Thresholds = THRESHOLDS


class ResidualStructure(NamedTuple):
    """Results of both tests."""

    shapes: list[CandidateScore]
    """Scores of all shapes, the best first."""
    coloured: dict[str, float]
    """p-value of a smooth (autocorrelated) random disturbance along each of `AXES`, by axis."""
    size: EffectSize
    """Size of the best shape, if it is significant, else 0; the drift is not computed."""


def disturbance_equations(
    evidence: RolloutEvidence, windows: FlightWindows, estimate: Estimate
) -> DisturbanceEquations:
    """Return the normal equations of a disturbance that may explain the residual at `estimate`.

    `windows` are those of the `evidence`, or the same with another input.
    """
    disturbed, knot = evidence.model.respond(estimate, windows)
    equations = block_of(evidence.whitening, disturbed, range(6 * KNOTS)).equations
    shapes = _shapes(knot, np.asarray(windows.start_s))
    return DisturbanceEquations(
        equations.hessian, equations.gradient, knot, *shapes, evidence.limits
    )


def residual_structure(
    equations: DisturbanceEquations, fold: np.ndarray, seed: int = 0
) -> ResidualStructure:
    """Test the residual by both tests; `fold` (W,) are the folds of the windows."""
    # From forces and torques at the knots to coefficients of the shapes.
    hessian, gradient = _along(equations, equations.unit)
    size = np.sqrt(np.maximum(np.einsum("wjj->j", hessian), 1e-12))
    scaled = (hessian / np.outer(size, size), gradient / size)
    shapes, limits = equations.shapes, equations.limits
    groups = [shape.indices for shape in shapes]
    scores = permutation_test(shapes, *scaled, groups, (), fold, seed, limits=limits)
    coloured = {axis: _energy_p_value(equations, i) for i, axis in enumerate(AXES)}
    return ResidualStructure(scores, coloured, _size(equations, scores))


def beyond_model_error(
    structure: ResidualStructure,
    equations: DisturbanceEquations,
    coarse: DisturbanceEquations,
    share: float,
) -> ResidualStructure:
    """Return `structure` without the shapes that the model's own error may explain.

    `coarse` has coarser inputs, see `RolloutSource.coarser`. The `share` of the change of a shape's
    coefficients counts as the error.
    """

    def error_of(columns: Sequence[int], value: np.ndarray) -> np.ndarray:
        return share * np.abs(_fit(coarse, columns)[0] - value)

    def is_kept(shape: CandidateScore) -> bool:
        if shape.p_value > equations.limits.shape_p_value:
            return True
        columns = shape.candidate.indices
        value, covariance = _fit(equations, columns)
        width = Z95 * np.sqrt(np.maximum(np.diag(covariance), 0.0))
        return beyond_error(value, error_of(columns, value), width)

    shapes = [shape for shape in structure.shapes if is_kept(shape)]
    return structure._replace(shapes=shapes, size=_size(equations, shapes, error_of))


def least_visible(
    equations: DisturbanceEquations, coarse: DisturbanceEquations | None, share: float
) -> EffectSize:
    """Return the smallest constant force and torque that the windows show, along the worst axis.

    It is `Thresholds.visible_sigma` standard errors, if nothing else is fitted, and the model's own
    error (see `beyond_model_error`; none if `coarse` is None). The drift is not computed.
    """
    each_axis = np.tile(np.eye(6), (KNOTS, 1))

    def fitted(one: DisturbanceEquations) -> tuple[np.ndarray, np.ndarray]:
        unit = np.broadcast_to(each_axis, (len(one.unit), 6 * KNOTS, 6))
        hessian, gradient = _along(one, unit)
        covariance = np.linalg.inv(hessian.sum(axis=0) + 1e-9 * np.eye(6))
        return covariance @ gradient.sum(axis=0), np.sqrt(np.diag(covariance))

    value, error = fitted(equations)
    size = equations.limits.visible_sigma * error
    if coarse is not None:
        size += share * np.abs(fitted(coarse)[0] - value)
    force, torque = size.reshape(2, 3).max(axis=1).tolist()
    return EffectSize(force, torque, None)


def _fit(equations: DisturbanceEquations, columns: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the coefficients (C,) of columns of the shapes, and their covariance (C, C)."""
    hessian, gradient = _along(equations, equations.unit[..., list(columns)])
    covariance = np.linalg.pinv(hessian.sum(axis=0))
    return covariance @ gradient.sum(axis=0), covariance


def _size(
    equations: DisturbanceEquations,
    shapes: Sequence[CandidateScore],
    error_of: Callable[[Sequence[int], np.ndarray], np.ndarray | float] = lambda *_: 0.0,
) -> EffectSize:
    """Return the RMS force and torque that the best of `shapes` adds, without the fit's noise.

    The model's own error, which `error_of` gives for columns and coefficients, is subtracted.
    """
    if not shapes or shapes[0].p_value > equations.limits.shape_p_value:
        return EffectSize(0.0, 0.0, None)
    columns = list(shapes[0].candidate.indices)
    value, covariance = _fit(equations, columns)
    value = less_error(value, error_of(columns, value))
    unit = equations.unit[..., columns]
    power = (unit @ value) ** 2 - np.einsum("wkc,cd,wkd->wk", unit, covariance, unit)
    # Three forces, then three torques, at each knot.
    mean = power.reshape(len(power), -1, 2, 3).sum(axis=-1).mean(axis=(0, 1))
    force, torque = np.sqrt(np.maximum(mean, 0.0)).tolist()
    return EffectSize(force, torque, None)


def _along(equations: DisturbanceEquations, unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return J'J (W, C, C) and J'r (W, C) by coefficients of the columns `unit` (W, 6 KNOTS, C)."""
    transposed = np.swapaxes(unit, 1, 2)
    gradient = (transposed @ equations.gradient[..., None])[..., 0]
    return transposed @ equations.hessian @ unit, gradient


def diagonalised(
    hessian: np.ndarray, gradient: np.ndarray, root: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return information and gradient (W, J) along independent directions of `root` (..., K, J)."""
    information, vectors = np.linalg.eigh(root.mT @ hessian @ root)
    return information, (vectors.mT @ (root.mT @ gradient[..., None]))[..., 0]


def _energy_p_value(equations: DisturbanceEquations, axis: int) -> float:
    """Return the p-value of a random disturbance along `axis`, over several correlation times.

    For one correlation time, the eigenvectors of the information are independent directions of the
    disturbance. Along each direction, the squared gradient over the information l measures the
    energy. It is weighted by s^2 l / (1 + s^2 l), as in the likelihood of a disturbance of size s.
    With a small s, directions with much information (slow changes) count most; with a large s, all
    directions count. The weighted sum is approximately gamma distributed (Satterthwaite 1946). The
    smallest p-value is multiplied by the number of tests (Bonferroni).
    """
    entries = np.arange(KNOTS) * 6 + axis
    hessian = equations.hessian[:, entries][:, :, entries]
    gradient = equations.gradient[:, entries]
    time = np.linspace(0.0, 1.0, KNOTS)
    p_values = []
    for correlation_s in (0.3, 0.03):  # as of gusts and of rotors
        root = np.linalg.cholesky(np.exp(-np.abs(time[:, None] - time) / correlation_s))
        information, along = diagonalised(hessian, gradient, root)
        # Directions with almost no information are left out.
        informed = information > 1e-9 * max(float(information.max()), 1e-12)
        information, along = information[informed], along[informed]
        for share in (0.9, 0.5, 0.1):  # quantiles that set the tested sizes
            size = 1.0 / np.quantile(information, share)
            weight = size * information / (1.0 + size * information)
            mean = float(weight.sum())
            # The measured noise power has a relative uncertainty of 2 %.
            variance = 2.0 * float((weight**2).sum()) + (0.02 * mean) ** 2
            energy = float((weight * (along**2 / information)).sum())
            p_values.append(float(gamma.sf(energy, mean**2 / variance, scale=variance / mean)))
    return min(1.0, len(p_values) * min(p_values))


def _shapes(knot: Flight, start_s: np.ndarray) -> tuple[np.ndarray, list[Candidate]]:
    """Return `unit` and `shapes` of `DisturbanceEquations`; `start_s` (W,) as in the windows."""
    pos_w, rot_w, vel_w, rate_b = (np.asarray(field) for field in knot.motion)
    axes_b = np.swapaxes(rot_w, -1, -2)
    vel_b = (axes_b @ vel_w[..., None])[..., 0]
    thrust = np.asarray(knot.acc_b)[..., 2] / GRAVITY
    change = np.gradient(thrust, axis=1) * (KNOTS - 1) * GRAVITY
    speed = np.sqrt((vel_w**2).sum(axis=-1))
    yaw = np.arctan2(rot_w[..., 1, 0], rot_w[..., 0, 0])
    time = start_s[:, None] + np.linspace(0.0, 1.0, KNOTS)
    # Keys must differ: two have a trailing space, which the labels of their scores do not.
    scalars = {
        "nothing: it is constant": np.ones_like(speed),
        "the time in flight": time,
        "the height": pos_w[..., 2],
        "nearness to the ground": 1.0 / (0.1 + np.maximum(pos_w[..., 2], 0.0)) ** 2,
        "the speed": speed,
        "the speed's square": speed**2,
        "the climb": vel_w[..., 2],
        "the sinking": np.maximum(-vel_w[..., 2], 0.0) ** 2,
        **{f"the velocity along body {a}": vel_b[..., i] for i, a in enumerate("xyz")},
        **{f"the square along body {a}": vel_b[..., i] ** 2 for i, a in enumerate("xyz")},
        **{f"the {a} rate": rate_b[..., i] for i, a in enumerate(("roll", "pitch", "yaw"))},
        "the thrust": thrust,
        "the thrust's square": thrust**2,
        "the thrust's change": change,
        "the thrust's direction of change": np.tanh(change / 10.0),  # above 10 m/s^3
        "thrust times velocity along x": thrust * vel_b[..., 0],
        "thrust times velocity along y": thrust * vel_b[..., 1],
        "the heading": np.cos(yaw),
        "the heading ": np.sin(yaw),
        "twice the heading": np.cos(2.0 * yaw),
        "twice the heading ": np.sin(2.0 * yaw),
    }
    columns, shapes = list[np.ndarray](), list[Candidate]()

    def add(label: str, own: list[np.ndarray]) -> None:
        indices, label = tuple(range(len(columns), len(columns) + len(own))), label.rstrip()
        shapes.append(Candidate(label, indices, label))
        columns.extend(own)

    # Each scalar times a force along each body axis, and times a torque about each body axis.
    unit_axes = np.eye(6)
    for label, scalar in scalars.items():
        along = scalar[..., None, None] * unit_axes
        add(f"force with {label}", [along[..., i, :] for i in range(3)])
        add(f"torque with {label}", [along[..., i, :] for i in range(3, 6)])
    # A drag whose dependence on the speed is free.
    motion = [hat[..., None] * vel_b for hat in _hats(speed)]
    add("force with the motion, by its speed", [
        along_b[..., i, None] * unit_axes[i] for along_b in motion for i in range(3)
    ])  # fmt: skip
    for label, scalar in (("thrust", thrust), ("climb", vel_w[..., 2]), ("height", pos_w[..., 2])):
        along_z = [hat[..., None] * unit_axes[2] for hat in _hats(scalar)]
        add(f"force along body z, by the {label}", along_z)
    # Forces along world axes, everywhere or near a place.
    world = np.concatenate([axes_b, np.zeros_like(axes_b)], axis=-2)
    add("force along fixed directions", [world[..., i] for i in range(3)])
    add("force with the place", [
        world[..., i] * bump[..., None] for bump in _bumps(pos_w) for i in range(3)
    ])  # fmt: skip
    from_centre_b = np.einsum("wkij,wkj->wki", axes_b, pos_w - pos_w.mean(axis=(0, 1)))
    radial = np.concatenate([from_centre_b, np.zeros_like(from_centre_b)], axis=-1)
    add("force towards a place", [radial])
    stacked = np.stack(columns, axis=-1)
    return stacked.reshape(len(stacked), KNOTS * 6, -1), shapes


def _hats(scalar: np.ndarray) -> list[np.ndarray]:
    """Return hat functions of `scalar` (W, KNOTS), each (W, KNOTS), on six of its quantiles."""
    corners = np.unique(np.quantile(scalar, np.linspace(0.0, 1.0, 6)))
    return [np.interp(scalar, corners, heights) for heights in np.eye(len(corners))]


def _bumps(pos_w: np.ndarray) -> list[np.ndarray]:
    """Return 4 x 4 Gaussian bumps on a grid over the horizontal positions, each (W, KNOTS)."""
    low, high = pos_w[..., :2].min(axis=(0, 1)), pos_w[..., :2].max(axis=(0, 1))
    width = np.maximum(high - low, 0.5) / 3
    distances = [(pos_w[..., :2] - low) / width - cell for cell in np.ndindex(4, 4)]
    return [np.exp(-0.5 * (distance**2).sum(axis=-1) / 0.5**2) for distance in distances]
