"""The source of evidence `whole`: whole flights, simulated in stretches of 1 s (rollouts).

Arrays have W windows (stretches), N rows of each, and 19 channels (position, attitude, velocity,
rates, accelerometer, rotor speeds).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from eval.effects import EFFECTS
from eval.effects.log_faults import pose_delay
from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.flights import ready
from suite.diagnose.data.view import FORCE
from suite.diagnose.data.whitening import block_of, make_whitening, slow_energy
from suite.diagnose.data.windows import (
    SLICES,
    STATE_GROUPS,
    UNITS,
    FlightWindows,
    take,
)
from suite.diagnose.estimate.gauss_newton import TINY, Z95, solve
from suite.diagnose.estimate.parameters import Candidate
from suite.diagnose.evidence.evidence import Evaluation
from suite.diagnose.evidence.rollouts import (
    RolloutEvidence,
    RolloutModel,
    rollout_evidence,
    start_estimate,
)
from suite.diagnose.evidence.view_means import ForceModel
from suite.diagnose.evidence.views import ViewEvidence
from suite.diagnose.search.evaluation import SearchResult
from suite.diagnose.sources.source import (
    FITTED,
    GIVEN,
    TOO_SMALL,
    Finding,
    Remaining,
    Series,
    Source,
    sizes_by_effect,
)
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict.actuators import TestedEffect
from suite.diagnose.verdict.disturbances import Swing, find_turbulence, residual_swing
from suite.diagnose.verdict.gap import (
    FORCE_S,
    TORQUE_S,
    EffectSize,
    Gap,
    from_true_starts,
    gap_of,
    overlap,
    remaining_share,
    rollout_size,
    start_correction,
)
from suite.diagnose.verdict.residual_structure import (
    DisturbanceEquations,
    ResidualStructure,
    beyond_model_error,
    disturbance_equations,
    least_visible,
    residual_structure,
)

SHOWN = 4
"""Number of held-out flights in pictures and recordings."""
ROUNDING_S = 1e-6
"""Start times that differ by less are equal [s]."""
Rollouts = tuple[FlightWindows, dict[str, np.ndarray]]
"""Windows, and their errors by label of the model; see `RolloutSource.simulated`."""
SHAPES = 5
"""Largest number of shapes of the residual (functions of the state) in the report."""


def of_rollouts(evaluation: Evaluation) -> RolloutEvidence:
    """Return the evidence of an evaluation of rollouts, with its exact type."""
    assert isinstance(evaluation.evidence, RolloutEvidence)
    return evaluation.evidence


@dataclass(frozen=True, kw_only=True)
class RolloutSource(Source):
    """Rollouts of 1 s as a source; its gap is the error of rollouts on held-out flights."""

    model: RolloutModel
    """Model of the nominal vehicle."""
    logs: Sequence[FlightLog]
    vehicle: Vehicle
    """The nominal vehicle, which the simulation uses."""
    rotor_input: bool
    """Whether measured rotor speeds are the model's input, not the commands."""
    cut: Callable[..., tuple[FlightWindows | None, list[str]]]
    """Cuts windows of the logs, see `Stretches.cut`."""
    held: FlightWindows
    """Overlapping 1 s windows of the held-out part."""
    since_s: float
    """Time in a flight at which its held-out part begins [s]; above 0 only for a single flight."""
    coarser: FlightWindows | None = None
    """The fitted windows, but with every second rotor speed only, or with the other course of
    commands (held, or means half-way) if the log may lack commands; None if neither matters. The
    difference in the result shows how much."""
    coarser_share: float = 0.5
    """Share of an effect's change under `coarser` that counts as the model's numerical error."""

    def gap(self, found: SearchResult, theta: np.ndarray) -> Gap:
        """Return the gap on the held-out flights, see `Source`."""
        linear = from_true_starts(self.model, theta, self.held)
        return gap_of(linear, of_rollouts(found.last).noise, self.limits)

    def is_worse(self, before: Gap, after: Gap) -> bool:
        """Return whether the gap has grown by more than chance, see `Source`."""
        return after.exceeds(before, overlap(self.held), self.limits)

    def would_show(self, found: SearchResult, candidate: Candidate) -> bool:
        """Return whether `candidate` should change the slow held-out errors significantly."""
        theta, indices = found.estimate.theta, list(candidate.indices)
        linear = from_true_starts(self.model, theta, self.held, indices)
        whitening = make_whitening(linear, of_rollouts(found.last).noise, self.limits)
        slope = block_of(whitening, linear, indices).slope
        change = (theta - self.start.theta)[indices]
        # Windows overlap, and `overlap` makes each row count once. Gaps compare slow errors only.
        expected_chi2 = float(slow_energy(whitening, slope @ change).sum()) * overlap(self.held)
        return bool(expected_chi2 > self.limits.shown_chi2)

    def is_relevant(self, gap: Gap) -> bool:
        """Return whether the upper end of the errors' 95 % interval exceeds the noise relevantly.

        Rollouts overlap, so the number of independent ones is the held-out time in seconds.
        """
        independent = max(len(self.held.flight) * overlap(self.held), 1.0)
        # A standard deviation of n normal errors has the relative standard error 1 / sqrt(2 n).
        upper = 1.0 + Z95 / np.sqrt(2.0 * independent)

        def excess(horizon: str, group: str) -> float:
            """Return the error of a group of channels beyond the noise, after a time."""
            error, floor = gap.channels[horizon][group]
            return float(np.sqrt(max((upper * error) ** 2 - floor**2, 0.0)))

        force, torque = excess("0.5 s", "velocity") / FORCE_S, excess("0.1 s", "rates") / TORQUE_S
        return EffectSize(force, torque, excess("1 s", "position")).relevant(self.limits)

    def sizes(self, found: SearchResult) -> dict[str, tuple[EffectSize, EffectSize]]:
        """Return the sizes of the named effects on the fitted flights, see `Source`.

        If measured rotor speeds are the input, the model has a numerical error, since the speeds
        between two rows are unknown. To estimate it, the effect is fitted again with every second
        rotor speed only. Half of the change counts as the error; for an error of second order it
        would be a third (step doubling; Hairer, Norsett & Wanner 1993, Sec. II.4). Rows further
        apart than the rotors' lag show the torque only to a factor of two, so twice the change
        counts (`coarser_share`). If the log may lack commands, the whole
        change counts, and twice the change if it does.
        """
        model, estimate, indices = self.model, found.estimate, found.indices
        windows = of_rollouts(found.last).trusted
        slope = model.linearise(estimate, windows, indices).slope
        model_error = np.zeros(len(indices))
        if self.coarser is not None and len(indices):
            directions = [*indices, *model.starts]
            linear = model.linearise(estimate, self.coarser, directions)
            options = (found.last.evidence.limits, of_rollouts(found.last).noise, indices)
            equations = rollout_evidence(model, linear, *options)[1].equations
            # Without bounds, as a bound would hide the error of a number that lies on it.
            scale, most = self.space.array("step")[list(indices)], np.full(len(indices), np.inf)
            change = solve(*equations.sums(), -most, most, scale)
            model_error = self.coarser_share * np.abs(change)
        size_of = partial(rollout_size, windows=windows, rotor_input=self.rotor_input)
        return sizes_by_effect(found, slope, size_of, model_error)

    def remaining(self, found: SearchResult, gaps: tuple[Gap, Gap], seed: int) -> Remaining:
        """Return the structure in the error that remains after `found`, see `Source`.

        Random wind and an oscillating force (swing) are tested apart: no parameter reproduces them.
        """
        evidence = of_rollouts(found.last)
        equations = disturbance_equations(evidence, evidence.trusted, found.estimate)
        coarse = None
        if self.coarser is not None:
            coarse = disturbance_equations(evidence, self.coarser, found.estimate)
        structure, wind = self._structure(found, equations, coarse, seed)
        details = {
            "shapes": [
                {"label": shape.candidate.label, "gain": shape.gain, "p_value": shape.p_value}
                for shape in structure.shapes[:SHAPES]
            ],
            "coloured": structure.coloured,
        }
        share = remaining_share(*gaps) if found.named else 0.0
        visible = least_visible(equations, coarse, self.coarser_share)
        noise = Remaining(False, share, visible=visible, details=details)
        if not (structure.size.relevant(self.limits) or self.is_relevant(gaps[1])):
            return noise._replace(reason=TOO_SMALL)
        # Slow errors are those that a low polynomial over a window describes: noise has few.
        slow = evidence.slow_errors(found.last.block)
        has_error = self.held.input_error is not None
        is_uncertain = self.rotor_input or self.coarser is not None or has_error
        where = structure_where(slow, structure, is_uncertain, self.limits)
        swing = self._swing(found.estimate.theta) if wind or where else None
        # Wind explains the structure, unless the force oscillates regularly.
        if wind and not swing:
            reason = "by the random course of the wind"
            return noise._replace(share=remaining_share(*gaps), reason=reason, wind=wind)
        if (where or swing) and not found.named:
            share = 1.0
        return noise._replace(
            structured=bool(where or swing), share=share, where=where, swing=swing
        )

    def _structure(
        self,
        found: SearchResult,
        equations: DisturbanceEquations,
        coarse: DisturbanceEquations | None,
        seed: int,
    ) -> tuple[ResidualStructure, TestedEffect | None]:
        """Return the structure in the remaining error, and the wind that may cause it.

        `coarse` is that with coarser inputs, if any.
        """
        evidence = of_rollouts(found.last)
        residual = residual_structure(equations, evidence.folds(found.last.block), seed)
        wind = self._wind(found, equations, residual)
        if coarse is not None:
            residual = beyond_model_error(residual, equations, coarse, self.coarser_share)
        return residual, wind

    def _wind(
        self, found: SearchResult, equations: DisturbanceEquations, residual: ResidualStructure
    ) -> TestedEffect | None:
        """Return the random wind that causes the remaining error, if any."""
        force_p_values = [p for axis, p in residual.coloured.items() if axis.startswith("force")]
        if not any(p <= self.limits.colour_p_value for p in force_p_values):
            return None
        found_wind = find_turbulence(self.model, found.estimate.theta, equations)
        if found_wind is None:
            return None
        # Wind is not named if a force that is a simple function of the state explains more.
        (wind, log_ratio), shape = found_wind, residual.shapes[0]
        if shape.p_value <= self.limits.shape_p_value and shape.gain > log_ratio:
            return None
        return wind

    def _swing(self, theta: np.ndarray) -> Swing | None:
        """Return an oscillating force in the force view of all flights at `theta` (P,), if any."""
        try:
            flights = ready(self.logs, self.vehicle, self.limits).smoothed[FORCE.name]
        except ValueError:  # no flight meets the conditions of the force view
            return None
        voltage = all(log.voltage is not None for log in self.logs)
        model = ForceModel(self.vehicle, voltage)
        return residual_swing(ViewEvidence(FORCE, model, flights, limits=self.limits), theta)

    def model_error(self, found: SearchResult) -> float:
        """Return the share of the noise floor that is the model's numerical error, see `Source`.

        It is the largest share among the groups of channels of the state.
        """
        groups, sigma = len(STATE_GROUPS), of_rollouts(found.last).noise.sigma
        least = np.array(self.limits.least_noise)[:groups]
        # `with_model_error` raised the lower limit of the noise to the model's numerical error
        # where that is larger than the default limit.
        is_raised = least > np.array(THRESHOLDS.least_noise)[:groups]
        noise = np.sqrt(np.nan_to_num(sigma[: 3 * groups].reshape(-1, 3) ** 2).mean(axis=1))
        share = np.where(is_raised, least / np.maximum(noise, TINY), 0.0)
        return float(min(share.max(), 1.0))

    def simulated(self, found: SearchResult) -> Rollouts:
        """Return 1 s windows of some held-out flights, and their errors by label of the model.

        The errors are measured - simulated (W, N, 19) by the vehicle file and, if something is
        named, by the fitted model. Both start from the state that fits the better model.
        """
        windows, _ = self.cut(only=np.unique(self.held.flight)[:SHOWN].tolist())
        assert windows is not None  # the diagnosis has cut them before
        windows = take(windows, np.asarray(windows.start_s) >= self.since_s - ROUNDING_S)
        noise, best = of_rollouts(found.last).noise, found.estimate.theta
        correction = start_correction(self.model, best, windows, noise, self.limits)

        def errors(theta: np.ndarray) -> np.ndarray:
            at = start_estimate(self.model, windows, theta)
            return self.model.residual(at._replace(free=at.free + correction), windows)

        named = {FITTED: errors(best)} if found.named else {}
        return windows, {GIVEN: errors(self.start.theta), **named}

    def series(
        self, found: SearchResult, rollouts: Rollouts | None = None, worst: str = GIVEN
    ) -> Series:
        """Return a held-out flight along the axis with the clearest error in `rollouts`.

        `worst` is the label of the model whose error counts.
        """
        windows, simulated = rollouts or self.simulated(found)
        rows = np.asarray(windows.flight) == windows.flight[0]
        groups = ("position", "velocity", "rates")
        channels = np.concatenate([np.r_[SLICES[group]] for group in groups])
        row = take(windows.row, rows)
        measured = np.concatenate([row.pos_w, row.vel_w, row.rate_b], axis=-1)
        is_logged = np.asarray(windows.valid)[rows][..., channels]
        errors = {label: values[rows][..., channels] for label, values in simulated.items()}
        # The axis with the largest error relative to the noise.
        error = np.where(is_logged, errors[worst], np.nan)
        power = np.ma.masked_invalid(error**2).mean(axis=(0, 1)).filled(0.0)
        noise = np.nan_to_num(of_rollouts(found.last).noise.sigma[channels], nan=np.inf)
        channel = int((power / noise**2).argmax())
        group, axis = groups[channel // 3], "xyz"[channel % 3]
        time_s = (np.asarray(windows.start_s)[:, None] + np.asarray(windows.row_s))[rows]
        value = np.where(is_logged, measured, np.nan)[..., channel]

        def line(values: np.ndarray) -> np.ndarray:
            """Return the rollouts as one line of a chart, with a break (NaN) after each."""
            return np.pad(values, ((0, 0), (0, 1)), constant_values=np.nan).ravel()

        return Series(
            line(time_s),
            line(value),
            {label: line(value - error[..., channel]) for label, error in errors.items()},
            f"{group.capitalize()} along {'body' if group == 'rates' else 'world'} {axis} "
            f"[{UNITS[group]}]",
            "A held-out flight in rollouts of a second. Each starts from the measured state, "
            "corrected within its noise. Shown is the axis with the largest error in units of "
            f"noise when {worst}.",
        )


def structure_where(
    slow_errors: tuple[np.ndarray, np.ndarray],
    residual: ResidualStructure,
    noise_is_uncertain: bool,
    limits: Thresholds = THRESHOLDS,
) -> str | None:
    """Return in words the quantity that a structured residual depends on; None if it is noise.

    For `slow_errors` see `RolloutEvidence`. Where the noise is uncertain, thresholds are higher.
    """
    slow, expected = slow_errors
    shape = residual.shapes[0] if residual.shapes else None
    if shape and (shape.p_value > limits.shape_p_value or not residual.size.relevant(limits)):
        shape = None
    # Axes along which the residual is correlated in time.
    coloured = [
        axis
        for axis, p_value in residual.coloured.items()
        if p_value <= limits.colour_p_value and not noise_is_uncertain
    ]
    least = limits.structure_rotor_input if noise_is_uncertain else limits.structure
    if not (shape or coloured or slow.sum() / expected.sum() > least):
        return None
    where = [shape.candidate.label] if shape else []
    for quantity in ("force", "torque"):
        axes = [axis[-1] for axis in coloured if axis.startswith(quantity)]
        if axes:
            where.append(f"a changing {quantity} along body {', '.join(axes)}")
    if where:
        return "; ".join(where)
    # The three channels whose slow errors exceed the expected ones most, of three axes a group.
    excess = np.maximum(slow.sum(axis=0) / np.maximum(expected.sum(axis=0), 1e-9) - 1.0, 0.0)
    worst = [k for k in np.argsort(-excess)[:3] if excess[k] > 0]
    return "errors of " + ", ".join(f"{STATE_GROUPS[k // 3]} {'xyz'[k % 3]}" for k in worst)


def pose_delays(found: SearchResult) -> dict[str, float]:
    """Return the delay [s] of the logged pose by name, of those named effects that describe one."""
    values = found.judged.evidence.space.effects(found.estimate.theta)
    named = dict.fromkeys(candidate.name for candidate in found.candidates)
    return {name: float(pose_delay({name: values[name]})) for name in named if EFFECTS[name].late}


def rollouts_of(finding: Finding) -> RolloutSource | None:
    """Return the source of `finding` if it is one of rollouts."""
    return finding.source if isinstance(finding.source, RolloutSource) else None
