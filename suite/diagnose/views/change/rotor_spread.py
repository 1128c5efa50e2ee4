"""How flights of one unchanged vehicle differ: as though its rotors were off, each time otherwise.

Each rotor's thrust is taken to be off by a little of its own in each flight, so that few flights
tell by how much along all axes at once. An axis's own differences count beside that: a moderated
variance (Smyth 2004).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from suite.diagnose.views.fit.by_flight import means_of
from suite.diagnose.views.fit.equations import ViewTask, left_of


@dataclass(frozen=True)
class RotorSpread:
    """How flights of one unchanged vehicle differ."""

    share: float
    """Standard deviation of a rotor's thrust from flight to flight, by all axes together [1]."""
    freedom: int
    """Degrees of freedom that it was estimated with."""
    along: Mapping[str, np.ndarray]
    """By view, the same along each axis (3,): its own differences beside those of all."""
    freedom_along: Mapping[str, np.ndarray]
    """By view, degrees of freedom of each axis's own differences (3,)."""
    prior: int
    """Degrees of freedom for which the spread of all axes counts beside an axis's own."""

    def sizes(self, view: str, draws: int, rng: np.random.Generator) -> np.ndarray:
        """Return draws (D, 3) of the square of `along` over the true one, where all axes are alike.

        Where it comes out small, changes come out large.
        """
        freedom = np.concatenate(list(self.freedom_along.values()))
        square = rng.chisquare(np.maximum(freedom, 1e-9), (draws, len(freedom)))
        pooled = square.sum(axis=1, keepdims=True) / max(self.freedom, 1)
        at = 3 * list(self.freedom_along).index(view) + np.arange(3)
        return _moderated(pooled, square[:, at], freedom[at], self.prior)


def _moderated(
    pooled: np.ndarray | float, square: np.ndarray, freedom: np.ndarray, prior: int
) -> np.ndarray:
    """Return an axis's variance by its own squares beside that of all (Smyth 2004)."""
    return (prior * pooled + square) / (prior + freedom)


def rotor_gain(task: ViewTask) -> np.ndarray:
    """Return what a rotor's own change of thrust does along each axis (3,), all four together."""
    space = task.model.space
    at = [i for i, entry in enumerate(space.entries) if entry.effect == "weak_motor"]
    slope = left_of(task, space.array("start")).slope[..., at].mean(axis=0)
    return np.sqrt((slope**2).sum(axis=1))


def rotor_spread(sets: Sequence[ViewTask]) -> RotorSpread:
    """Return how flights differ within each of `sets`: the reference's and the others', by view."""
    square: dict[str, np.ndarray] = defaultdict(lambda: np.zeros(3))
    freedom: dict[str, np.ndarray] = defaultdict(lambda: np.zeros(3, int))
    for task in sets:
        data, gain = left_of(task, task.model.space.array("start")), rotor_gain(task)
        means = means_of(data.residual, data.flight)
        axes = gain > task.limits.least_rotor_gain * gain.max()
        if task.view.in_world:
            axes &= np.arange(3) == 2  # across the thrust rotors do nothing
        away = (means - means.mean(axis=0)) / np.where(axes, gain, np.inf)
        square[task.view.name] += (away**2).sum(axis=0)
        freedom[task.view.name] += axes * (len(means) - 1)
    count = int(sum(one.sum() for one in freedom.values()))
    share = float(np.sqrt(sum(one.sum() for one in square.values()) / max(count, 1)))
    prior = sets[0].limits.spread_freedom
    along = {
        name: np.sqrt(_moderated(share**2, square[name], freedom[name], prior)) for name in square
    }
    return RotorSpread(share, count, along, dict(freedom), prior)
