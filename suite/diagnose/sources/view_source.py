"""The sources of evidence `force` and `torque`, which compare mean accelerations with the model.

Accelerations are averaged over short windows; M is the number of these means. A black box, a ridge
regression without physics, is fitted to the same flights. It estimates how much of the error any
model could explain, and whether structure remains beyond the named effects.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from suite.diagnose.data.view import SmoothedFlight, View
from suite.diagnose.estimate.gauss_newton import TINY
from suite.diagnose.evidence.evidence import validation_groups
from suite.diagnose.evidence.view_means import centred, means_of
from suite.diagnose.evidence.views import ViewBlock, ViewEvidence
from suite.diagnose.search.evaluation import SearchResult
from suite.diagnose.sources.source import (
    FITTED,
    GIVEN,
    Remaining,
    Series,
    Source,
    sizes_by_effect,
)
from suite.diagnose.verdict.disturbances import residual_swing
from suite.diagnose.verdict.gap import Channel, EffectSize, Gap, rms_length

STRETCH_S = 10.0
"""Length of the stretch in a chart [s]."""
QUANTITIES = {"force": "acceleration", "torque": "angular acceleration"}
"""Compared quantity, by the name of a view."""
UNPREDICTED = "that logged signals hardly predict"
NO_AGREEMENT = "on which the flights do not agree"
"""Reasons why an error of a view does not count as structure, see `Remaining.reason`."""
RIDGES = (1e-3, 1e-2, 1e-1, 1.0, 10.0)
"""Ridge weights that are tried, relative to the weight of the data."""
PATTERNS = np.array([[1, 1, 1, 1], [-1, -1, 1, 1], [-1, 1, 1, -1], [1, -1, 1, -1]])
"""Sums and differences of the four rotors' thrusts: collective thrust, roll, pitch and yaw."""


@dataclass(frozen=True, kw_only=True)
class ViewSource(Source):
    """One view (force or torque): its gap is the error of mean accelerations."""

    view: View
    held: ViewEvidence
    """The held-out flights."""
    floor: np.ndarray
    """(3,) noise of a mean acceleration by body axis [the view's unit]."""
    reason = UNPREDICTED
    """Why an error above the noise floor does not count as structure, see `Remaining.reason`."""
    all_flights: ViewEvidence | None = None
    """All flights, to search for an oscillating force; None in a torque view."""

    def gap(self, found: SearchResult, theta: np.ndarray) -> Gap:
        """Return the gap on the held-out flights, see `Source`."""
        data = self.held.residuals(theta)
        within = self._within(data.residual, data.flight)
        error = np.sqrt((within**2).mean(axis=0))
        energy = (within**2).sum(axis=1)
        channels = {
            "xyz"[k]: Channel(float(error[k]), float(self.floor[k])) for k in self.view.axes
        }
        floor = float(np.sqrt(self._noise_power))
        offset = rms_length(data.residual - within)
        return Gap(energy, energy, {self.name: channels}, floor, offset, self.block)

    @property
    def block(self) -> int:
        """Number of neighbouring means that a bootstrap draws together."""
        return round(self.limits.view_block_s / self.view.spacing_s)

    def _within(self, residual: np.ndarray, flight: np.ndarray) -> np.ndarray:
        """Return the `residual` (M, 3) without each flight's mean (its trim)."""
        return centred(residual, flight)

    def sizes(self, found: SearchResult) -> dict[str, tuple[EffectSize, EffectSize]]:
        """Return the sizes of the named effects on the fitted flights, see `Source`."""
        block = found.last.block
        assert isinstance(block, ViewBlock)
        slope = block.data.slope[..., [block.along.index(index) for index in found.indices]]
        return sizes_by_effect(
            found, slope, lambda shift, z=0.0: self.size_of(rms_length(shift, z))
        )

    def size_of(self, rms: float) -> EffectSize:
        """Return the size of an effect that changes mean accelerations by `rms` [view's unit]."""
        return EffectSize(rms, 0.0, None) if self.view.in_world else EffectSize(0.0, rms, None)

    def remaining(self, found: SearchResult, gaps: tuple[Gap, Gap], seed: int) -> Remaining:
        """Return the error that a black box explains beyond the named effects, see `Source`.

        In a force view, an oscillating force and a force that no signal predicts are tested too.
        """
        shares = self._shares(found)
        by_axis = shares.beyond if found.named else shares.explainable
        share, beyond = shares.total(by_axis), shares.total(shares.beyond)
        # The error has structure if a black box explains a relevant part of it.
        size = self.size_of(float(np.sqrt(share * shares.variance.sum())))
        structured = size.relevant(self.limits) and share > self.limits.view_left_share
        axis = max(self.view.axes, key=lambda k: float(shares.beyond[k] * shares.variance[k]))
        where = (
            f"{self.name} along body {'xyz'[axis]}, of which a regression without physics explains "
            f"a further {100 * max(float(shares.beyond[axis]), 0.0):.0f} %"
        )
        # A force view is also tested for an oscillating force (swing), and for a force that even
        # the black box does not explain.
        swing = None
        if self.all_flights is not None:
            swing = residual_swing(self.all_flights, found.estimate.theta)
            force = self._unexplained_force(found.estimate.theta, gaps[1], seed)
            if force and not structured:
                energy, left = (max(gap.energy.mean() - self._noise_power, 0.0) for gap in gaps)
                structured, beyond = True, max(beyond, float(left / max(energy, left, TINY)))
                where = (
                    f"a force of {force:.2g} m/s^2 beyond the noise, which a regression on the "
                    "logged signals does not predict"
                )
        closed, explainable = shares.total(shares.closed), shares.total(shares.explainable)
        return Remaining(
            structured,
            beyond,
            where,
            self.reason,
            explainable,
            swing=swing,
            gap_details={"closed": closed, "explainable": explainable},
            channels={self.name: {"xyz"[k]: shares.along(k) for k in self.view.axes}},
        )

    @property
    def _noise_power(self) -> float:
        """Mean square of the measurement noise along the compared axes."""
        return float((self.floor[list(self.view.axes)] ** 2).sum())

    def _unexplained_force(self, theta: np.ndarray, gap: Gap, seed: int) -> float:
        """Return the force [m/s^2] that remains within held-out flights, or 0 if insignificant.

        `gap` is the gap at `theta` (P,). It has to exceed noise and a least force significantly:
        the threshold of relevance or, if larger, a multiple of the flights' constant offsets
        (trims), which show the accuracy of attitude and thrust in the logs. The torque has no such
        test, since noise of the rotor speeds dominates its remaining error.
        """
        assert self.all_flights is not None
        data, limits = self.all_flights.residuals(theta), self.limits
        offset = means_of(data.residual, data.flight)
        trim = limits.unexplained_trim * float(np.sqrt((offset**2).sum(axis=1).mean()))
        least = max(limits.relevance[0], min(trim, limits.unexplained_force))
        if gap.energy_low95(seed) < self._noise_power + least**2:
            return 0.0
        return float(np.sqrt(gap.energy.mean() - self._noise_power))

    def _shares(self, found: SearchResult) -> Shares:
        """Return the shares of the error that the named effects and a black box explain."""
        evidence = found.last.evidence
        assert isinstance(evidence, ViewEvidence)
        before = self.held.residuals(found.start.theta)
        after = self.held.residuals(found.estimate.theta)
        # Fit one black box to the error of the given vehicle, and a second one to the error that
        # remains with the named effects. Both are tested on the held-out flights.
        inputs, held_inputs = (
            np.concatenate([inputs_of(flight) for flight in flights])
            for flights in (evidence.flights, self.held.flights)
        )

        def unpredicted(theta: np.ndarray, held: np.ndarray) -> np.ndarray:
            """Return the `held` residual (M, 3) without the part that a black box predicts."""
            fitted = evidence.residuals(theta)
            return held - held_inputs @ fit_black_box(inputs, fitted.residual, fitted.flight)

        closed, explainable, with_both = (
            closed_share(before.residual, error, before.flight)
            for error in (
                after.residual,
                unpredicted(found.start.theta, before.residual),
                unpredicted(found.estimate.theta, after.residual),
            )
        )
        variance = (centred(before.residual, before.flight) ** 2).mean(axis=0)
        beyond, spread = with_both - closed, evidence.repeatability
        explainable = np.maximum(np.maximum(explainable, closed), 0.0)
        return Shares(closed, explainable, beyond, variance, spread)

    def series(self, found: SearchResult) -> Series:
        """Return the stretch that the named effects change most, or else that of most error."""
        before = self.held.residuals(found.start.theta)
        after = self.held.residuals(found.estimate.theta)
        shares = self._shares(found)
        weight = shares.variance * (shares.closed if found.named else 1.0)
        axis = max(self.view.axes, key=lambda k: float(weight[k]))
        rows = before.flight == before.flight[0]
        middle = before.middle_s[rows]
        change = before.residual - (after.residual if found.named else 0.0)
        size = np.abs(change[rows, axis])
        count = max(int((middle < middle[0] + STRETCH_S).sum()), 2)
        # The convolution sums the change over each stretch of `count` points.
        first = int(np.convolve(size, np.ones(min(count, len(size))), "valid").argmax())
        shown = slice(first, first + count)
        measured = (before.value + before.residual)[rows, axis][shown]
        lines = {GIVEN: before.value[rows, axis][shown]}
        if found.named:
            lines[FITTED] = measured - after.residual[rows, axis][shown]
        quantity = QUANTITIES[self.name].capitalize()
        return Series(
            middle[shown] - middle[shown][0],
            measured,
            lines,
            f"{quantity} along body {'xyz'[axis]} [{self.unit}]",
            "A stretch of a held-out flight, with its constant offset.",
        )


class Shares(NamedTuple):
    """Shares of the error's variance within flights that models explain, by body axis (3,)."""

    closed: np.ndarray
    """Share that the named effects explain."""
    explainable: np.ndarray
    """Share that a black box explains, which is fitted to the same flights."""
    beyond: np.ndarray
    """Further share that a black box explains, beyond the named effects."""
    variance: np.ndarray
    """Variance of the error of the given vehicle [the view's unit squared]."""
    repeatability: np.ndarray
    """Standard deviation of the flights' means [the view's unit]; infinite with too few flights."""

    def total(self, by_axis: np.ndarray) -> float:
        """Return the share of all axes together from the shares by axis (3,); at least 0."""
        return float(max((by_axis * self.variance).sum() / max(self.variance.sum(), TINY), 0.0))

    def along(self, axis: int) -> dict[str, float | None]:
        """Return the entries of diagnosis.json for one axis."""
        shares = {
            key: getattr(self, key)[axis] for key in ("repeatability", "closed", "explainable")
        }
        return {key: float(share) if np.isfinite(share) else None for key, share in shares.items()}


def fit_black_box(inputs: np.ndarray, error: np.ndarray, flight: np.ndarray) -> np.ndarray:
    """Return the weights (K, 3) with which `inputs` (M, K) explain `error` (M, 3) best.

    They are those of a ridge regression without flights' means (trims), chosen in cross-validation
    over flights or thirds of one.
    """
    groups = validation_groups(flight)
    inputs, error = centred(inputs, flight), centred(error, flight)
    scale = np.maximum(inputs.std(axis=0), 1e-9)
    scaled = inputs / scale

    def solve(rows: np.ndarray, ridge: float) -> np.ndarray:
        """Return the weights (K, 3) of a ridge regression on the chosen rows."""
        square = scaled[rows].T @ scaled[rows] + ridge * rows.sum() * np.eye(scaled.shape[1])
        return np.linalg.solve(square, scaled[rows].T @ error[rows])

    def held_error(ridge: float) -> np.ndarray:
        """Return the squared error (3,) on the groups, each left out of the fit in turn."""
        left_out = [groups == group for group in np.unique(groups)]
        errors = [error[rows] - scaled[rows] @ solve(~rows, ridge) for rows in left_out]
        return (np.concatenate(errors) ** 2).sum(axis=0)

    # Each axis takes its best ridge weight, or weights of 0 if even that predicts worse than 0.
    held_errors = [held_error(ridge) for ridge in RIDGES]
    best = np.argmin(held_errors, axis=0)
    all_rows = np.ones(len(groups), bool)
    columns = [solve(all_rows, RIDGES[k])[:, axis] for axis, k in enumerate(best)]
    zero_is_better = (error**2).sum(axis=0) <= np.min(held_errors, axis=0)
    return np.where(zero_is_better, 0.0, np.stack(columns, axis=1)) / scale[:, None]


def closed_share(before: np.ndarray, after: np.ndarray, flight: np.ndarray) -> np.ndarray:
    """Return the share (3,) of the variance within flights that `before` has and `after` lacks."""
    power = (centred(before, flight) ** 2).sum(axis=0)
    return 1.0 - (centred(after, flight) ** 2).sum(axis=0) / np.maximum(power, TINY)


def inputs_of(flight: SmoothedFlight) -> np.ndarray:
    """Return the inputs (M, K) of the black box: means of a flight's signals and their products."""
    rows, vel_b = flight.rows, flight.rows.vel_b
    thrust = rows.rotor_speed**2
    thrust = thrust / np.maximum(thrust.mean(), 1e-9)
    mixed = thrust @ PATTERNS.T / 4.0
    # The height matters near the ground only.
    nearness_to_ground = 1.0 / (1.0 + np.maximum(rows.motion.pos_w[:, 2:], 0.0))
    drop = rows.voltage_drop[:, None]
    signals = np.concatenate([vel_b, rows.motion.rate_b, mixed, nearness_to_ground, drop], axis=1)
    row, column = np.triu_indices(signals.shape[1])
    speed = np.linalg.norm(vel_b, axis=1, keepdims=True)
    products = [signals, signals[:, row] * signals[:, column], speed * vel_b]
    return flight.form.mean @ np.concatenate(products, axis=1)
