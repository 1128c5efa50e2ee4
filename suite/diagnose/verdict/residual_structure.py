"""What the model leaves over: is there structure, what does it go with, how is it coloured.

A further force and torque on a grid of knots along every window stands for whatever the model
lacks. Two questions are put to it, neither of which needs a name: does one plain shape over the
state (`shapes`) lower the error on flights that were left out, as a candidate would; and is there
more energy in it than noise gives, whatever it goes with (a score test of a smooth random push).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import gamma

from suite.diagnose.data.windows import Windows
from suite.diagnose.fit.model import Model
from suite.diagnose.fit.normal_equations import Frame, State, free, white_residual, whiten
from suite.diagnose.fit.permutation import compare
from suite.diagnose.fit.rollout import KNOTS, Flown
from suite.diagnose.fit.shapes import Shapes, shapes_of

COLOURS_S = (0.3, 0.03)
"""Times for which a random push keeps its direction [s]."""
SIZES = (0.9, 0.5, 0.1)
"""Quantiles of the information along all directions at which a push begins to be seen."""
SEEN = 1e-9
"""Directions with less than this share of the largest information are not looked at."""
NOISE_DOUBT = 0.02
"""Share by which the measured noise power may be wrong."""
AXES = ("force x", "force y", "force z", "torque x", "torque y", "torque z")


class Push(NamedTuple):
    """Normal equations of a further push at the knots of W windows."""

    square: np.ndarray
    """(W, 6 KNOTS, 6 KNOTS)."""
    cross: np.ndarray
    """(W, 6 KNOTS)."""
    knot: Flown
    """(W, KNOTS, ...) the flight at the knots."""
    shapes: Shapes


class Shape(NamedTuple):
    """How much one shape explains of what is left over."""

    label: str
    gain: float
    p_value: float
    """As in `select.Score`."""


class Rest(NamedTuple):
    """What is left over."""

    shapes: list[Shape]
    """Best first."""
    coloured: dict[str, float]
    """By axis: p-value of the energy of a smooth random push along it, were there none."""


def push_of(model: Model, windows: Windows, frame: Frame, state: State) -> Push:
    """Return the normal equations of a push on what `state` leaves over."""
    response = model.respond(state.theta, state.offset, windows)
    linear = model.linearise(state.theta, state.offset, windows, [])
    residual = free(frame, white_residual(frame, linear))[..., 0]
    slope = free(frame, whiten(frame, response.slope))
    turned = np.swapaxes(slope, 1, 2)
    return Push(
        turned @ slope,
        (turned @ residual[..., None])[..., 0],
        response.knot,
        shapes_of(response.knot, np.asarray(windows.start_s)),
    )


def rest_of(push: Push, fold: np.ndarray, seed: int = 0) -> Rest:
    """Return the structure in `push`.

    Args:
        push: of the windows.
        fold: (W,) windows of one number are left out together.
        seed: of the null's draws.
    """
    along = push.shapes.push
    turned = np.swapaxes(along, 1, 2)
    square = turned @ push.square @ along
    cross = (turned @ push.cross[..., None])[..., 0]
    size = np.sqrt(np.maximum(np.einsum("wjj->j", square), 1e-12))
    groups = push.shapes.groups
    gains, p_values, _ = compare(
        square / np.outer(size, size), cross / size, [g.columns for g in groups], (), fold, seed
    )
    found = [Shape(g.label, *x) for g, *x in zip(groups, gains, p_values, strict=True)]
    return Rest(
        sorted(found, key=lambda shape: -shape.gain),
        {axis: _energy(push, i) for i, axis in enumerate(AXES)},
    )


def _energy(push: Push, axis: int) -> float:
    """Return the p-value of the energy of a random push along `axis`, over several colours.

    Along the directions in which a push of one colour is uncorrelated, before and after the data,
    z are the pulls over their noise. What a push of size s adds is weighed as the likelihood weighs
    it, by s^2 l / (1 + s^2 l) with l the information along the direction: a small s looks at slow
    pushes, a large one at all. The sum of weighed squares is close to a gamma variable
    (Satterthwaite 1946).
    """
    at = np.arange(KNOTS) * 6 + axis
    square = push.square[:, at][:, :, at]
    cross = push.cross[:, at, None]
    time = np.linspace(0.0, 1.0, KNOTS)
    found = []
    for keeps_s in COLOURS_S:
        root = np.linalg.cholesky(np.exp(-np.abs(time[:, None] - time) / keeps_s))
        values, vectors = np.linalg.eigh(root.T @ square @ root)
        seen = values > SEEN * max(float(values.max()), 1e-12)
        pulls = (np.swapaxes(vectors, 1, 2) @ (root.T @ cross))[..., 0]
        power = pulls[seen] ** 2 / values[seen]
        for share in SIZES:
            size = 1.0 / np.quantile(values[seen], share)
            weight = size * values[seen] / (1.0 + size * values[seen])
            mean = float(weight.sum())
            spread = 2.0 * float((weight**2).sum()) + (NOISE_DOUBT * mean) ** 2
            value = float((weight * power).sum())
            found.append(float(gamma.sf(value, mean**2 / spread, scale=spread / mean)))
    return min(1.0, len(found) * min(found)) if found else 1.0
