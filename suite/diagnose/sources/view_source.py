"""The sources `force` and `torque`, with a black box as the limit of what any model explains.

The black box is a ridge regression without physics, fitted to the same flights. It shows how much
of the residual could be explained at all, and whether structure remains beyond the named effects.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from suite.diagnose.data.view import FlightRows, SmoothedFlight, View
from suite.diagnose.evidence.moments import centred, means_of, units_of
from suite.diagnose.evidence.views import ViewBlock, ViewEvidence
from suite.diagnose.search.change import search_motion_change
from suite.diagnose.search.evaluation import Evaluation, SearchResult
from suite.diagnose.sources.source import Remaining, Series, Source
from suite.diagnose.verdict.disturbances import swing_left
from suite.diagnose.verdict.gap import Channel, EffectSize, Gap, upper_size, view_size

STRETCH_S = 10.0
"""Length of the stretch in a picture [s]."""
WHAT = {"force": "acceleration", "torque": "angular acceleration"}


@dataclass(frozen=True, kw_only=True)
class ViewSource(Source):
    """One view (force or torque): its gap is the error of mean accelerations."""

    view: View
    held: ViewEvidence
    """The held-out flights."""
    floor: np.ndarray
    """(3,) standard deviation of a mean acceleration by measurement noise, by body axis."""
    every: ViewEvidence | None = None
    """All flights, in which an oscillating force is searched for; None in a torque view."""

    def gap(self, found: SearchResult, theta: np.ndarray) -> Gap:
        """Return the gap on the held-out flights, see `Source`."""
        left = self.held.left(theta)
        # Where only means of flights are compared, each is a flight of its own.
        own = left.residual if self.held.means else centred(left.residual, left.flight)
        error = _rms(left.residual)
        channels = {
            "xyz"[k]: Channel(float(error[k]), float(self.floor[k])) for k in self.view.axes
        }
        return Gap(
            (left.residual**2).sum(axis=1),
            (own**2).sum(axis=1),
            {self.name: channels},
            float(np.sqrt((self.floor**2).sum())),
        )

    def sizes(self, found: SearchResult) -> dict[str, tuple[EffectSize, EffectSize]]:
        """Return what the names do on the fitted flights, see `Source`."""
        block = found.last.block
        assert isinstance(block, ViewBlock)
        width, away = found.half_widths(), found.moved

        def size_of(moved: np.ndarray) -> EffectSize:
            return view_size(moved, self.view.in_world)

        sizes = {}
        for name in dict.fromkeys(one.candidate.name for one in found.named):
            at = [k for k, i in enumerate(found.indices) if self.space.entries[i].effect == name]
            slope = block.data.slope[..., [block.along.index(found.indices[k]) for k in at]]
            upper = upper_size(slope, away[at], width[at], size_of)
            sizes[name] = (size_of(slope @ away[at]), upper)
        return sizes

    def remaining(self, found: SearchResult, gaps: tuple[Gap, Gap], seed: int) -> Remaining:
        """Return what a black box closes beyond the names, see `Source`."""
        shares = self._shares(found)
        by_axis = shares.left if found.named else shares.explainable
        share, left = shares.whole(by_axis), shares.whole(shares.left)
        rms = float(np.sqrt(share * shares.variance.sum()))
        size = EffectSize(rms, 0.0, None) if self.view.in_world else EffectSize(0.0, rms, None)
        structured = size.relevant(self.limits) and share > self.limits.view_left_share
        axis = max(self.view.axes, key=lambda k: float(shares.left[k] * shares.variance[k]))
        where = (
            f"{self.name} along body {'xyz'[axis]}, of which a regression without physics explains "
            f"a further {100 * max(float(shares.left[axis]), 0.0):.0f} %"
        )
        swing = None
        if self.every is not None:
            swing = swing_left(self.every, found.estimate.theta)
            force = self._unexplained(found.estimate.theta, gaps[1], seed)
            if force and not structured:
                structured, left = True, max(left, share_of_energy(*gaps, self._noise))
                where = (
                    f"a force of {force:.2g} m/s^2 beyond the noise, which no flown signal predicts"
                )
        closed, explainable = shares.whole(shares.closed), shares.whole(shares.explainable)
        return Remaining(
            structured,
            left,
            where,
            explainable,
            swing=swing,
            gap_details={"closed": closed, "explainable": explainable},
            channels={self.name: {"xyz"[k]: shares.along(k) for k in self.view.axes}},
        )

    @property
    def _noise(self) -> float:
        """Mean square that measurement noise gives along the axes that are compared."""
        return float((self.floor[list(self.view.axes)] ** 2).sum())

    def _unexplained(self, theta: np.ndarray, left: Gap, seed: int) -> float:
        """Return the force [m/s^2] that remains within held-out flights, 0 where it is no finding.

        It has to exceed the noise surely, and both the threshold of relevance and what the flights'
        constant offsets show attitude and thrust to be known to. The torque has no such test: noise
        of the rotor speeds is most of what remains of it. `left` is the gap at `theta` (P,).
        """
        assert self.every is not None
        data, limits = self.every.left(theta), self.limits
        offset = means_of(data.residual, data.flight)
        trim = limits.unexplained_trim * float(np.sqrt((offset**2).sum(axis=1).mean()))
        least = max(limits.relevance[0], min(trim, limits.unexplained_force))
        if left.least_energy(seed, limits) < self._noise + least**2:
            return 0.0
        return float(np.sqrt(left.energy.mean() - self._noise))

    def _shares(self, found: SearchResult) -> Shares:
        """Return which share of the error the names close, and a black box."""
        evidence = found.last.evidence
        assert isinstance(evidence, ViewEvidence)
        before, after = self.held.left(found.start.theta), self.held.left(found.estimate.theta)
        trim = np.where(np.isfinite(evidence.repeatability), evidence.repeatability, np.nan)
        if self.held.means:
            power = (before.residual**2).mean(axis=0)
            closed = 1.0 - (after.residual**2).mean(axis=0) / np.maximum(power, 1e-12)
            return Shares(closed, np.maximum(closed, 0.0), np.zeros(3), power, trim)
        start, fitted = evidence.left(found.start.theta), evidence.left(found.estimate.theta)
        inside = np.concatenate([inputs_of(flight) for flight in evidence.flights])
        outside = np.concatenate([inputs_of(flight) for flight in self.held.flights])
        whole = fit_black_box(inside, start.residual, start.flight)
        beyond = fit_black_box(inside, fitted.residual, fitted.flight)
        closed, explainable, both = (
            closed_share(before.residual, left, before.flight)
            for left in (
                after.residual,
                before.residual - whole.predict(outside),
                after.residual - beyond.predict(outside),
            )
        )
        variance = (centred(before.residual, before.flight) ** 2).mean(axis=0)
        return Shares(closed, np.maximum(explainable, closed), both - closed, variance, trim)

    def series(self, found: SearchResult) -> Series:
        """Return the stretch of a held-out flight that the names change most, see `Source`.

        Where nothing is named, the one with the largest error.
        """
        before, after = self.held.left(found.start.theta), self.held.left(found.estimate.theta)
        shares = self._shares(found)
        weight = shares.variance * (shares.closed if found.named else 1.0)
        axis = max(self.view.axes, key=lambda k: float(weight[k]))
        rows = before.flight == before.flight[0]
        middle = before.middle_s[rows]
        apart = before.residual - (after.residual if found.named else 0.0)
        moved = np.abs(apart[rows, axis])
        count = max(int((middle < middle[0] + STRETCH_S).sum()), 2)
        first = int(np.convolve(moved, np.ones(min(count, len(moved))), "valid").argmax())
        shown = slice(first, first + count)
        measured = (before.value + before.residual)[rows, axis][shown]
        lines = {"simulated as given": before.value[rows, axis][shown]}
        if found.named:
            named = measured - after.residual[rows, axis][shown]
            lines["simulated with what was named"] = named
        what = WHAT.get(self.name, self.name).capitalize()
        return Series(
            middle[shown] - middle[shown][0],
            measured,
            lines,
            f"{what} along body {'xyz'[axis]} [{self.unit}]",
            "A stretch of a held-out flight.",
        )


@dataclass(frozen=True, kw_only=True)
class MotionSource(ViewSource):
    """A change that shows only in motion, tested where no mean of a flight has changed."""

    reference: ViewEvidence
    fitted: ViewEvidence
    """The flights after the change."""

    def search(self, say: Callable[[str], None], seed: int) -> SearchResult:
        """Return what has changed since the reference flights, see `Source`."""
        del say, seed
        found = search_motion_change(self.reference, self.fitted, self.among)
        evidence, block = self.known
        none = Evaluation(evidence, self.start, block)
        return found or SearchResult((), self.start, none, none, [], 0.0)


class Shares(NamedTuple):
    """Share of the variance within flights that is explained ('closed'), by body axis (3,) [1]."""

    closed: np.ndarray
    """By the named effects."""
    explainable: np.ndarray
    """By a black box that is fitted to the same flights."""
    left: np.ndarray
    """By a black box, beyond the named effects."""
    variance: np.ndarray
    """Within flights, as given [the view's unit squared]."""
    repeatability: np.ndarray
    """Spread of flights' means [the view's unit]; NaN with too few flights."""

    def whole(self, by_axis: np.ndarray) -> float:
        """Return a share by axis (3,) as one of all axes together, at least 0."""
        return float(max((by_axis * self.variance).sum() / max(self.variance.sum(), 1e-12), 0.0))

    def along(self, axis: int) -> dict[str, float | None]:
        """Return the entries of an axis in diagnosis.json."""
        values = {
            "repeatability": self.repeatability,
            "closed": self.closed,
            "explainable": self.explainable,
        }
        return {
            key: float(one[axis]) if np.isfinite(one[axis]) else None for key, one in values.items()
        }


def share_of_energy(before: Gap, after: Gap, noise: float) -> float:
    """Return the share of the mean energy of `before`, less that of `noise`, that `after` has."""
    left = max(float(after.energy.mean()) - noise, 0.0)
    return left / max(float(before.energy.mean()) - noise, left, 1e-12)


def _rms(residual: np.ndarray) -> np.ndarray:
    return np.sqrt((residual**2).mean(axis=0))


RIDGES = (1e-3, 1e-2, 1e-1, 1.0, 10.0)
"""Ridge weights that are tried, relative to the weight of a mean."""


class BlackBox(NamedTuple):
    """A fitted black box."""

    spread: np.ndarray
    """(K,) of the inputs."""
    weight: np.ndarray
    """(K, 3)."""

    def predict(self, inputs: np.ndarray) -> np.ndarray:
        """Return its prediction (M, 3) for `inputs` (M, K)."""
        return (inputs / self.spread) @ self.weight


def inputs_of(flight: SmoothedFlight) -> np.ndarray:
    """Return the products (M, K) that a black box sees of a flight, smoothed as the view is."""
    return flight.form.mean @ _products(flight.rows)


def fit_black_box(inputs: np.ndarray, left: np.ndarray, flight: np.ndarray) -> BlackBox:
    """Return the black box that explains `left` (M, 3) best in cross-validation over flights.

    Means of flights, which are trims, are subtracted on both sides. `flight` (M,) is the number of
    each row's flight; a lone flight is split into thirds.
    """
    units = units_of(flight)
    inputs, left = centred(inputs, flight), centred(left, flight)
    spread = np.maximum(inputs.std(axis=0), 1e-9)
    scaled = inputs / spread

    def solve(rows: np.ndarray, ridge: float) -> np.ndarray:
        square = scaled[rows].T @ scaled[rows] + ridge * rows.sum() * np.eye(scaled.shape[1])
        return np.linalg.solve(square, scaled[rows].T @ left[rows])

    errors = []
    for ridge in RIDGES:
        missed = np.zeros(3)
        for unit in np.unique(units):
            out = units == unit
            missed += ((left[out] - scaled[out] @ solve(~out, ridge)) ** 2).sum(axis=0)
        errors.append(missed)
    best = np.argmin(errors, axis=0)
    every = np.ones(len(units), bool)
    columns = [solve(every, RIDGES[k])[:, axis] for axis, k in enumerate(best)]
    none = (left**2).sum(axis=0) <= np.min(errors, axis=0)  # predicting 0 is better
    return BlackBox(spread, np.where(none, 0.0, np.stack(columns, axis=1)))


def closed_share(left: np.ndarray, after: np.ndarray, flight: np.ndarray) -> np.ndarray:
    """Return the share (3,) of the variance of `left` (M, 3) within flights that is gone."""
    before = (centred(left, flight) ** 2).sum(axis=0)
    return 1.0 - (centred(after, flight) ** 2).sum(axis=0) / np.maximum(before, 1e-12)


def _products(rows: FlightRows) -> np.ndarray:
    """Return the inputs (N, K) on every row: what was flown, and its products by two."""
    vel_b = rows.vel_b
    push = rows.rotor_speed**2
    push = push / np.maximum(push.mean(), 1e-9)
    pairs = push @ np.array([[1, 1, 1, 1], [-1, -1, 1, 1], [-1, 1, 1, -1], [1, -1, 1, -1]]).T / 4.0
    # Near the ground heights matter; far from it no height is like no other.
    near = 1.0 / (1.0 + np.maximum(rows.pos_w[:, 2:], 0.0))
    one = np.concatenate([vel_b, rows.rate_b, pairs, near, rows.voltage_drop[:, None]], axis=1)
    row, column = np.triu_indices(one.shape[1])
    speed = np.linalg.norm(vel_b, axis=1, keepdims=True)
    return np.concatenate([one, one[:, row] * one[:, column], speed * vel_b], axis=1)
