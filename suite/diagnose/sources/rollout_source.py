"""The source of evidence `whole`: whole flights, simulated in stretches of 1 s (rollouts).

Its residuals are the differences between measured and simulated states. `FlightWindows` holds the
stretches, here also called windows. W is their number, N the number of rows of each, and 19 the
number of channels (position, attitude, velocity, rates, accelerometer, rotor speeds).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from eval.effects import EFFECTS
from eval.effects.log_faults import pose_delay
from suite.diagnose.data.flights import ready
from suite.diagnose.data.view import FORCE
from suite.diagnose.data.whitening import make_whitening
from suite.diagnose.data.windows import (
    SLICES,
    STATE_GROUPS,
    UNITS,
    FlightWindows,
)
from suite.diagnose.estimate.gauss_newton import TINY, Z95, gauss_newton_step
from suite.diagnose.estimate.parameters import Candidate, make_space
from suite.diagnose.estimate.permutation import folds_of
from suite.diagnose.evidence.moments import ForceModel
from suite.diagnose.evidence.rollouts import (
    RolloutEvidence,
    block_of,
    rollout_evidence,
)
from suite.diagnose.evidence.views import ViewEvidence
from suite.diagnose.search.evaluation import Evaluation, SearchResult
from suite.diagnose.sources.source import Remaining, Series, Source, sizes_by_effect
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict.actuators import TestedEffect
from suite.diagnose.verdict.disturbances import Swing, find_turbulence, residual_swing
from suite.diagnose.verdict.gap import (
    FORCE_S,
    TORQUE_S,
    EffectSize,
    Gap,
    remaining_share,
    rollout_size,
)
from suite.diagnose.verdict.residual_structure import (
    ResidualStructure,
    disturbance_equations,
    residual_structure,
)
from suite.diagnose.verdict.rollout_gap import (
    Rollouts,
    measure,
    overlap,
    true_starts,
)

SHAPES = 5
"""Largest number of shapes of the residual (functions of the state) in the report."""
CLEAR_NOISE = 4.0
"""A chart shows the axis with the clearest error: squared errors count above this many noise
variances."""


def of_rollouts(evaluation: Evaluation) -> RolloutEvidence:
    """Return the evidence of `evaluation`, which must be one of rollouts, with its exact type."""
    assert isinstance(evaluation.evidence, RolloutEvidence)
    return evaluation.evidence


@dataclass(frozen=True, kw_only=True)
class RolloutSource(Source):
    """Rollouts of 1 s as a source; its gap is the error of rollouts on held-out flights."""

    flown: Rollouts
    """The flights, the model that simulates them, and their held-out windows."""
    coarser: FlightWindows | None = None
    """The fitted windows, but with every second rotor speed only; None if commands are the input.
    The difference in the result shows how much the time between rotor speeds matters."""
    coarser_share: float = 0.5
    """Share of an effect's change under `coarser` that counts as the model's numerical error."""

    @property
    def rollouts(self) -> Rollouts:
        """The simulated flights, see `Source`."""
        return self.flown

    def gap(self, found: SearchResult, theta: np.ndarray) -> Gap:
        """Return the gap on the held-out flights, see `Source`."""
        flights, noise = self.flown, of_rollouts(found.last).noise
        return measure(flights.model, theta, flights.held, noise, self.limits)

    def is_worse(self, before: Gap, after: Gap) -> bool:
        """Return whether the gap has grown by more than chance, see `Source`."""
        return after.exceeds(before, overlap(self.limits), 0, self.limits)

    def would_show(self, found: SearchResult, candidate: Candidate) -> bool:
        """Return whether held-out flights are sensitive to `candidate`, see `Source`.

        They are if the effect's fitted size should change their chi-square significantly.
        """
        model, held = self.flown.model, self.flown.held
        theta, indices = found.estimate.theta, list(candidate.indices)
        offset = true_starts(model, theta, held)
        linear = model.linearise(theta, offset, held, [*indices, *model.starts])
        whitening = make_whitening(linear, of_rollouts(found.last).noise, held, self.limits)
        slope = block_of(whitening, linear, indices, held).slope
        change = theta[indices] - self.flown.start[indices]
        # Windows overlap, and `overlap` makes each row count once.
        expected_chi2 = float(((slope @ change) ** 2).sum()) * overlap(self.limits)
        return bool(expected_chi2 > self.limits.shown_chi2)

    def is_relevant(self, gap: Gap) -> bool:
        """Return whether rollout errors may exceed the noise by a relevant amount.

        The upper end of the error's 95 % interval is compared with the thresholds. Rollouts overlap
        in time. The number of independent rollouts is therefore the held-out time in seconds.
        """
        force, torque, drift = self.limits.relevance
        independent = max(len(self.flown.held.flight) * self.limits.gap_stride_s, 1.0)
        # A standard deviation of n normal errors has the relative standard error 1 / sqrt(2 n).
        upper = 1.0 + Z95 / np.sqrt(2.0 * independent)

        def excess(horizon: str, group: str) -> float:
            """Return the error of a group of channels beyond the noise, after a time."""
            error, floor = gap.channels[horizon][group]
            return float(np.sqrt(max((upper * error) ** 2 - floor**2, 0.0)))

        return bool(
            excess("1 s", "position") >= drift
            or excess("0.5 s", "velocity") >= FORCE_S * force
            or excess("0.1 s", "rates") >= TORQUE_S * torque
        )

    def sizes(self, found: SearchResult) -> dict[str, tuple[EffectSize, EffectSize]]:
        """Return the sizes of the named effects on the fitted flights, see `Source`.

        If measured rotor speeds are the input, the model has a numerical error, since the speeds
        between two rows are unknown. This error is subtracted before the upper end is computed.

        To estimate it, the effect is fitted again with every second rotor speed only. Half of the
        change counts as the error; for an error of second order it would be a third (step doubling;
        Hairer, Norsett & Wanner 1993, Sec. II.4). Rows further apart than the rotors' lag (their
        time constant) do not show all torque. The change then estimates the missing torque only to
        a factor of two, so twice the change is subtracted (`coarser_share`).
        """
        model, estimate, indices = self.flown.model, found.estimate, found.indices
        windows = of_rollouts(found.last).trusted
        slope = model.linearise(estimate.theta, estimate.free, windows, indices).slope
        model_error = np.zeros(len(indices))
        if self.coarser is not None and len(indices):
            directions = [*indices, *model.starts]
            linear = model.linearise(estimate.theta, estimate.free, self.coarser, directions)
            options = (found.last.evidence.limits, of_rollouts(found.last).noise, indices)
            equations = rollout_evidence(model, self.coarser, linear, *options)[1].equations
            change, _ = gauss_newton_step(equations, estimate.theta, model.space)
            model_error = self.coarser_share * np.abs(change)
        return sizes_by_effect(found, slope, lambda c: rollout_size(c, windows), model_error)

    def remaining(self, found: SearchResult, gaps: tuple[Gap, Gap], seed: int) -> Remaining:
        """Return the structure in the error that remains after `found`, see `Source`.

        If there is structure, random wind and an oscillating force (swing) are tested, since no
        parameter of the search reproduces them.
        """
        structure, wind = self._structure(found, seed)
        details = {
            "shapes": [shape._asdict() for shape in structure.shapes[:SHAPES]],
            "coloured": structure.coloured,
        }
        share = remaining_share(*gaps) if found.named else 0.0
        if not self.is_relevant(gaps[1]):
            return Remaining(False, share, details=details)
        # Slow errors are those that a low polynomial over a window describes: noise has few.
        slow = of_rollouts(found.last).slow_errors(found.last.block)
        where = structure_where(slow, structure, self.flown.rotor_input, self.limits)
        swing = self._swing(found.estimate.theta) if wind or where else None
        # Wind explains the structure, unless the force oscillates regularly.
        if wind and not swing:
            return Remaining(False, remaining_share(*gaps), wind=wind, details=details)
        if (where or swing) and not found.named:
            share = 1.0
        return Remaining(bool(where or swing), share, where, swing=swing, details=details)

    def _structure(
        self, found: SearchResult, seed: int
    ) -> tuple[ResidualStructure, TestedEffect | None]:
        """Return the structure in the remaining error, and the wind that may cause it."""
        evidence, limits, model = of_rollouts(found.last), self.limits, self.flown.model
        windows, whitening = evidence.trusted, evidence.whitening
        equations = disturbance_equations(model, windows, whitening, found.estimate, limits)
        fold = folds_of(windows.flight, windows.start_s, limits.folds)
        residual = residual_structure(equations, fold, seed, limits)
        force_p_values = [p for axis, p in residual.coloured.items() if axis.startswith("force")]
        if not any(p <= limits.colour_p_value for p in force_p_values):
            return residual, None
        found_wind = find_turbulence(model, found.estimate.theta, equations, limits)
        if found_wind is None:
            return residual, None
        # Wind is not named if a force that is a simple function of the state explains more.
        (wind, log_ratio), shape = found_wind, residual.shapes[0]
        if shape.p_value <= limits.shape_p_value and shape.gain > log_ratio:
            return residual, None
        return residual, wind

    def _swing(self, theta: np.ndarray) -> Swing | None:
        """Return an oscillating force in the flights' force errors at `theta` (P,), if any.

        It is searched for in all flights with the force view, which has one value at each time.
        """
        flown = self.flown
        try:
            flights = ready(flown.logs, flown.vehicle, self.limits).smoothed[FORCE.name]
        except ValueError:  # no flight meets the conditions of the force view
            return None
        voltage = all(log.voltage is not None for log in flown.logs)
        model = ForceModel(flown.vehicle, make_space(flown.vehicle), voltage)
        return residual_swing(ViewEvidence(FORCE, model, flights, self.limits), theta)

    def explained_by_steps(self, found: SearchResult) -> bool:
        """Return whether MuJoCo's Euler steps explain a named delay between pose and rates.

        In a flight that MuJoCo simulated, pose and rates differ by about half a step in time.
        """
        step_s = 1.0 / self.flown.vehicle.controller.frequency
        delays_s = pose_delays(found).values()
        return any(abs(delay_s) <= self.limits.integrator_share * step_s for delay_s in delays_s)

    def model_error(self, found: SearchResult) -> float:
        """Return the share of the noise floor that is the model's numerical error, see `Source`.

        It is the largest share among the groups of channels (position, attitude, velocity, rates).
        """
        groups, sigma = len(STATE_GROUPS), of_rollouts(found.last).noise.sigma
        least = np.array(self.limits.least_noise)[:groups]
        # `with_model_error` raised the lower limit of the noise to the model's numerical error
        # where that is larger than the default limit.
        is_raised = least > np.array(THRESHOLDS.least_noise)[:groups]
        noise = np.sqrt(np.nan_to_num(sigma[: 3 * groups].reshape(-1, 3) ** 2).mean(axis=1))
        share = np.where(is_raised, least / np.maximum(noise, TINY), 0.0)
        return float(min(share.max(), 1.0))

    def series(self, found: SearchResult) -> Series:
        """Return a held-out flight along the axis with the clearest error, see `Source`."""
        windows, simulated = self.flown.simulated(found.estimate.theta if found.named else None)
        sigma = of_rollouts(found.last).noise.sigma
        rows = np.asarray(windows.flight) == windows.flight[0]
        measured = {
            group: np.asarray(values)[rows]
            for group, values in (
                ("position", windows.row_pos_w),
                ("velocity", windows.row_vel_w),
                ("rates", windows.row_rate_b),
            )
        }
        is_logged = np.asarray(windows.valid)[rows]
        errors = {label: values[rows] for label, values in simulated.items()}
        error_as_given = next(iter(errors.values()))

        def relative_error(group: str, axis: int) -> float:
            """Return the squared error beyond noise, divided by the variance of the motion."""
            channel = SLICES[group].start + axis
            known = is_logged[..., channel] & np.isfinite(error_as_given[..., channel])
            if not known.any():
                return -np.inf
            error, motion = error_as_given[..., channel][known], measured[group][..., axis][known]
            noise = float(sigma[channel]) ** 2
            excess = float((error**2).mean() - CLEAR_NOISE * noise)
            return excess / max(float(motion.var()), noise)

        axes = [(group, axis) for group in measured for axis in range(3)]
        group, axis = max(axes, key=lambda pair: relative_error(*pair))
        channel = SLICES[group].start + axis
        time_s = (np.asarray(windows.start_s)[:, None] + np.asarray(windows.row_s))[rows]
        value = np.where(is_logged[..., channel], measured[group][..., axis], np.nan)

        def line(values: np.ndarray) -> np.ndarray:
            """Return the rollouts as one line of a chart, with a break (NaN) after each."""
            return np.pad(values, ((0, 0), (0, 1)), constant_values=np.nan).ravel()

        frame = "body" if group == "rates" else "world"
        lines = {label: line(value - error[..., channel]) for label, error in errors.items()}
        return Series(
            line(time_s),
            line(value),
            lines,
            f"{group.capitalize()} along {frame} {'xyz'[axis]} [{UNITS[group]}]",
            "A held-out flight in rollouts of a second from measured states, along the axis where "
            "the error is largest next to the motion.",
        )


def structure_where(
    slow_errors: tuple[np.ndarray, np.ndarray],
    residual: ResidualStructure,
    rotor_input: bool,
    limits: Thresholds = THRESHOLDS,
) -> str | None:
    """Return in words the quantity that a structured residual depends on; None if it is noise.

    Args:
        slow_errors: energy of slow errors and its expectation, from `RolloutEvidence.slow_errors`.
        residual: result of the tests for structure.
        rotor_input: whether measured rotor speeds are the input. The size of their noise is less
            certain, so the thresholds are higher.
        limits: thresholds above which structure is not noise.
    """
    slow, expected = slow_errors
    shape = residual.shapes[0] if residual.shapes else None
    if shape is not None and shape.p_value > limits.shape_p_value:
        shape = None
    # Axes along which the residual is correlated in time.
    coloured = [
        axis
        for axis, p_value in residual.coloured.items()
        if p_value <= limits.colour_p_value and not rotor_input
    ]
    least = limits.structure_rotor_input if rotor_input else limits.structure
    if not (shape or coloured or slow.sum() / expected.sum() > least):
        return None
    where = [shape.label] if shape else []
    for quantity in ("force", "torque"):
        axes = [axis[-1] for axis in coloured if axis.startswith(quantity)]
        if axes:
            where.append(f"a changing {quantity} along body {', '.join(axes)}")
    return "; ".join(where) or _worst_channels(slow.sum(axis=0), expected.sum(axis=0))


def _worst_channels(slow: np.ndarray, expected: np.ndarray) -> str:
    """Return in words the three channels whose slow errors exceed the expected ones most.

    `slow` and `expected` (12,) are energies of the errors by channel.
    """
    energy = np.maximum(slow / np.maximum(expected, 1e-9) - 1.0, 0.0)
    worst = [k for k in np.argsort(-energy)[:3] if energy[k] > 0]
    # Each group of channels has three axes.
    return "errors of " + ", ".join(f"{STATE_GROUPS[k // 3]} {'xyz'[k % 3]}" for k in worst)


def pose_delays(found: SearchResult) -> dict[str, float]:
    """Return the delay [s] of the logged pose that each named effect describes, by its name.

    Only effects that describe such a delay have an entry.
    """
    values = found.judged.evidence.space.effects(found.estimate.theta)
    named = dict.fromkeys(candidate.name for candidate in found.candidates)
    return {name: float(pose_delay({name: values[name]})) for name in named if EFFECTS[name].late}
