"""What the model leaves over: is there structure, what does it go with, how is it coloured.

A disturbance, a further force and torque on a grid of knots along every window, stands for whatever
the model lacks. Two questions are put to it, neither of which needs a name: does one plain shape
over the state (`shapes`) lower the error on flights that were left out, as a candidate would; and
is there more energy in it than noise gives, whatever it goes with (a score test of a smooth random
disturbance).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import gamma

from suite.diagnose.data.windows import FlightWindows
from suite.diagnose.fit.model import RolloutModel
from suite.diagnose.fit.normal_equations import Estimate, products
from suite.diagnose.fit.permutation import permutation_test
from suite.diagnose.fit.rollout import KNOTS, Flown
from suite.diagnose.fit.whitening import (
    Whitening,
    project_out_start,
    whiten,
    whitened_residual,
)
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict.shapes import ShapeLibrary, shape_library

AXES = ("force x", "force y", "force z", "torque x", "torque y", "torque z")


class DisturbanceEquations(NamedTuple):
    """Normal equations of a disturbance at the knots of W windows."""

    hessian: np.ndarray
    """(W, 6 KNOTS, 6 KNOTS)."""
    gradient: np.ndarray
    """(W, 6 KNOTS)."""
    knot: Flown
    """(W, KNOTS, ...) the flight at the knots."""
    shapes: ShapeLibrary


class ShapeScore(NamedTuple):
    """How much one shape explains of what is left over."""

    label: str
    gain: float
    p_value: float
    """As in `permutation.CandidateScore`."""


class ResidualStructure(NamedTuple):
    """Structure in what is left over."""

    shapes: list[ShapeScore]
    """Best first."""
    coloured: dict[str, float]
    """By axis: p-value of the energy of a smooth random disturbance along it, were there none."""


def disturbance_equations(
    model: RolloutModel,
    windows: FlightWindows,
    whitening: Whitening,
    estimate: Estimate,
    limits: Thresholds = THRESHOLDS,
) -> DisturbanceEquations:
    """Return the normal equations of a disturbance on what `estimate` leaves over."""
    response = model.respond(estimate.theta, estimate.offset, windows)
    linear = model.linearise(estimate.theta, estimate.offset, windows, [])
    residual = project_out_start(whitening, whitened_residual(whitening, linear))
    slope = project_out_start(whitening, whiten(whitening, response.slope))
    shapes = shape_library(response.knot, np.asarray(windows.start_s), limits)
    return DisturbanceEquations(*products(slope, residual), response.knot, shapes)


def residual_structure(
    equations: DisturbanceEquations,
    fold: np.ndarray,
    seed: int = 0,
    limits: Thresholds = THRESHOLDS,
) -> ResidualStructure:
    """Return the structure in what is left over; windows of one `fold` (W,) are left out together.

    `seed` is of the permutation test's draws.
    """
    along, groups = equations.shapes.unit, equations.shapes.groups
    turned = np.swapaxes(along, 1, 2)
    hessian = turned @ equations.hessian @ along
    gradient = (turned @ equations.gradient[..., None])[..., 0]
    size = np.sqrt(np.maximum(np.einsum("wjj->j", hessian), 1e-12))
    gains, p_values, _ = permutation_test(
        hessian / np.outer(size, size),
        gradient / size,
        [group.columns for group in groups],
        (),
        fold,
        seed,
        limits=limits,
    )
    found = [ShapeScore(g.label, *x) for g, *x in zip(groups, gains, p_values, strict=True)]
    return ResidualStructure(
        sorted(found, key=lambda shape: -shape.gain),
        {axis: _energy_p_value(equations, i, limits) for i, axis in enumerate(AXES)},
    )


def _energy_p_value(equations: DisturbanceEquations, axis: int, limits: Thresholds) -> float:
    """Return the p-value of the energy of a random disturbance along `axis`, over several colours.

    Along the directions in which a disturbance of one colour is uncorrelated, before and after the
    data, z are the pulls over their noise. What one of size s adds is weighed as the likelihood
    weighs it, by s^2 l / (1 + s^2 l) with l the information along the direction: a small s looks at
    slow ones, a large one at all. The sum of weighed squares is close to a gamma variable
    (Satterthwaite 1946).
    """
    at = np.arange(KNOTS) * 6 + axis
    hessian = equations.hessian[:, at][:, :, at]
    gradient = equations.gradient[:, at, None]
    time = np.linspace(0.0, 1.0, KNOTS)
    found = []
    for keeps_s in limits.colours_s:
        root = np.linalg.cholesky(np.exp(-np.abs(time[:, None] - time) / keeps_s))
        values, vectors = np.linalg.eigh(root.T @ hessian @ root)
        seen = values > limits.informed_share * max(float(values.max()), 1e-12)
        pulls = (np.swapaxes(vectors, 1, 2) @ (root.T @ gradient))[..., 0]
        power = pulls[seen] ** 2 / values[seen]
        for share in limits.disturbance_quantiles:
            size = 1.0 / np.quantile(values[seen], share)
            weight = size * values[seen] / (1.0 + size * values[seen])
            mean = float(weight.sum())
            spread = 2.0 * float((weight**2).sum()) + (limits.noise_doubt * mean) ** 2
            value = float((weight * power).sum())
            found.append(float(gamma.sf(value, mean**2 / spread, scale=spread / mean)))
    return min(1.0, len(found) * min(found)) if found else 1.0
