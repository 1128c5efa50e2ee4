"""The source `whole`: errors of simulated stretches of 1 s (rollouts) against the flights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from eval.effects import EFFECTS
from eval.effects.log_faults import lateness
from suite.diagnose.data.flights import ready
from suite.diagnose.data.view import FORCE
from suite.diagnose.data.whitening import make_whitening
from suite.diagnose.data.windows import (
    SLICES,
    STATE_GROUPS,
    UNITS,
    FlightWindows,
)
from suite.diagnose.estimate.gauss_newton import gauss_newton_step
from suite.diagnose.estimate.parameters import Candidate, make_space
from suite.diagnose.estimate.permutation import folds_of
from suite.diagnose.evidence.moments import ForceModel
from suite.diagnose.evidence.rollouts import (
    RolloutEvidence,
    block_of,
    weighed_by,
)
from suite.diagnose.evidence.views import ViewEvidence
from suite.diagnose.search.evaluation import Evaluation, SearchResult
from suite.diagnose.sources.source import Remaining, Series, Source, TestedEffect
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict.disturbances import Swing, find_turbulence, swing_left
from suite.diagnose.verdict.gap import (
    FORCE_S,
    TORQUE_S,
    EffectSize,
    Gap,
    rollout_size,
    share_left,
    upper_size,
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
"""Largest number of shapes of the residual in the report."""


def of_rollouts(evaluation: Evaluation) -> RolloutEvidence:
    """Return the evidence of `evaluation`, which is one of rollouts."""
    assert isinstance(evaluation.evidence, RolloutEvidence)
    return evaluation.evidence


@dataclass(frozen=True, kw_only=True)
class RolloutSource(Source):
    """Rollouts of 1 s as a source; its gap is the error of rollouts on held-out flights."""

    flown: Rollouts
    coarser: FlightWindows | None = None
    """The fitted windows with every second rotor speed, where measured ones are the input."""
    coarser_share: float = 0.5
    """Share of what that changes an effect by which is the model's own error [1]."""

    def gap(self, found: SearchResult, theta: np.ndarray) -> Gap:
        """Return the gap on the held-out flights, see `Source`."""
        flown, noise = self.flown, of_rollouts(found.last).noise
        return measure(flown.model, theta, flown.held, noise, self.limits)

    def worse(self, before: Gap, after: Gap) -> bool:
        """Return whether the gap has grown by more than chance, see `Source`."""
        return after.above(before, overlap(self.limits), 0, self.limits)

    def shows(self, found: SearchResult, one: Candidate) -> bool:
        """Return whether held-out flights would show it, see `Source`."""
        model, held = self.flown.model, self.flown.held
        theta, own = found.estimate.theta, list(one.indices)
        offset = true_starts(model, theta, held)
        linear = model.linearise(theta, offset, held, [*own, *model.starts])
        whitening = make_whitening(linear, of_rollouts(found.last).noise, held, self.limits)
        slope = block_of(whitening, linear, own, held).slope
        moved = theta[own] - self.flown.start[own]
        expected = float(((slope @ moved) ** 2).sum()) * overlap(self.limits)
        return bool(expected > self.limits.shown_chi2)

    def matters(self, gap: Gap) -> bool:
        """Return whether rollout errors may exceed the noise by a relevant amount.

        The upper end of the 95 % interval is compared. Rollouts overlap: only as many count as
        independent as fit into the flights without overlap.
        """
        force, torque, drift = self.limits.relevance
        independent = max(len(self.flown.held.flight) * self.limits.gap_stride_s, 1.0)
        wide = 1.0 + 1.96 / np.sqrt(2.0 * independent)

        def beyond(horizon: str, group: str) -> float:
            error, floor = gap.channels[horizon][group]
            return float(np.sqrt(max((wide * error) ** 2 - floor**2, 0.0)))

        return bool(
            beyond("1 s", "position") >= drift
            or beyond("0.5 s", "velocity") >= FORCE_S * force
            or beyond("0.1 s", "rates") >= TORQUE_S * torque
        )

    def sizes(self, found: SearchResult) -> dict[str, tuple[EffectSize, EffectSize]]:
        """Return what the names do on the fitted flights, see `Source`.

        Where measured rotor speeds drive, what the model's own error makes of an effect does not
        count at the upper end: half of what every second rotor speed alone changes it by, where an
        error of second order would make a third (step doubling; Hairer, Norsett & Wanner 1993,
        Sec. II.4). Where rows are further apart than the rotors' lag, the change is the torque that
        the rows are estimated not to show, which is known to a factor of two: twice it counts.
        """
        model, estimate, indices = self.flown.model, found.estimate, found.indices
        windows = of_rollouts(found.last).trusted
        slope = model.linearise(estimate.theta, estimate.free, windows, indices).slope
        width, away, own = found.half_widths(), found.moved, np.zeros(len(indices))
        if self.coarser is not None and len(indices):
            directions = [*indices, *model.starts]
            linear = model.linearise(estimate.theta, estimate.free, self.coarser, directions)
            how = (found.last.evidence.limits, of_rollouts(found.last).noise, indices)
            equations = weighed_by(model, self.coarser, linear, *how)[1].equations
            moved, _ = gauss_newton_step(equations, estimate.theta, model.space)
            own = self.coarser_share * np.abs(moved)

        def size_of(moved: np.ndarray) -> EffectSize:
            return rollout_size(moved, windows)

        sizes = {}
        for name in dict.fromkeys(one.candidate.name for one in found.named):
            at = [k for k, i in enumerate(indices) if model.space.entries[i].effect == name]
            sure = np.sign(away[at]) * np.maximum(np.abs(away[at]) - own[at], 0.0)
            upper = upper_size(slope[..., at], sure, width[at], size_of)
            sizes[name] = (size_of(slope[..., at] @ away[at]), upper)
        return sizes

    def remaining(self, found: SearchResult, gaps: tuple[Gap, Gap], seed: int) -> Remaining:
        """Return the structure in what `found` leaves, see `Source`.

        Where there is structure, random wind and an oscillating force are tested: no fitted
        parameter reproduces them.
        """
        structure, wind = self._structure(found, seed)
        details = {
            "shapes": [shape._asdict() for shape in structure.shapes[:SHAPES]],
            "coloured": structure.coloured,
        }
        named = bool(found.named)
        share = share_left(*gaps) if named else 0.0
        if not self.matters(gaps[1]):
            return Remaining(False, share, details=details)
        slow = of_rollouts(found.last).slow_errors(found.last.block)
        where = structure_where(slow, structure, self.flown.rotor_input, self.limits)
        swing = self._swing(found.estimate.theta) if wind or where else None
        if swing:
            wind = None
        elif wind:
            return Remaining(False, share_left(*gaps), wind=wind, details=details)
        if where or swing:
            share = share if named else 1.0
        return Remaining(bool(where or swing), share, where, swing=swing, details=details)

    def _structure(
        self, found: SearchResult, seed: int
    ) -> tuple[ResidualStructure, TestedEffect | None]:
        """Return the structure in what `found` leaves, and the wind that may have made it."""
        evidence, limits, model = of_rollouts(found.last), self.limits, self.flown.model
        windows, whitening = evidence.trusted, evidence.whitening
        equations = disturbance_equations(model, windows, whitening, found.estimate, limits)
        fold = folds_of(windows.flight, windows.start_s, limits.folds)
        residual = residual_structure(equations, fold, seed, limits)
        forces = [p for axis, p in residual.coloured.items() if axis.startswith("force")]
        if not any(p <= limits.colour_p_value for p in forces):
            return residual, None
        wind = find_turbulence(model, found.estimate.theta, equations, limits)
        # Wind is one explanation and a shape over the state another: the better one counts.
        shape = residual.shapes[0]
        if wind is None or (shape.p_value <= limits.shape_p_value and shape.gain > wind.ratio):
            return residual, None
        sizes = (("intensity", "m/s", wind.intensity, wind.intensity_ci95),
                 ("length", "m", wind.length, wind.length_ci95))  # fmt: skip
        parameters = {
            name: {"value": value, "unit": unit, "ci95": list(ci95)}
            for name, unit, value, ci95 in sizes
        }
        p_value = float(np.exp(-wind.ratio))
        return residual, TestedEffect(
            wind.effect, wind.values, parameters, None, p_value, self.name
        )

    def _swing(self, theta: np.ndarray) -> Swing | None:
        """Return the swing in what translation under the measured attitude leaves at `theta`."""
        flown = self.flown
        try:
            flights = ready(flown.logs, flown.vehicle, self.limits).smoothed[FORCE.name]
        except ValueError:  # rollouts need other stretches than this test does
            return None
        voltage = all(log.voltage is not None for log in flown.logs)
        model = ForceModel(flown.vehicle, make_space(flown.vehicle), voltage)
        return swing_left(ViewEvidence(FORCE, model, flights, self.limits), theta)

    def stepped(self, found: SearchResult) -> bool:
        """Return whether pose and rates are apart by what MuJoCo's Euler steps make of them."""
        step = 1.0 / self.flown.vehicle.controller.frequency
        late = late_by(found).values()
        return any(abs(offset) <= self.limits.integrator_share * step for offset in late)

    def model_error(self, found: SearchResult) -> float:
        """Return the share of the noise floor that is the model's own error, see `Source`.

        It is that of the group of channels in which it is largest.
        """
        groups, sigma = len(STATE_GROUPS), of_rollouts(found.last).noise.sigma
        least = np.array(self.limits.least_noise)[:groups]
        raised = least > np.array(THRESHOLDS.least_noise)[:groups]
        whole = np.sqrt(np.nan_to_num(sigma[: 3 * groups].reshape(-1, 3) ** 2).mean(axis=1))
        share = np.where(raised, least / np.maximum(whole, 1e-12), 0.0)
        return float(min(share.max(), 1.0))

    def series(self, found: SearchResult) -> Series:
        """Return a held-out flight along the axis where the error is best seen, see `Source`."""
        windows, simulated = self.flown.simulated(found.estimate.theta if found.named else None)
        sigma = of_rollouts(found.last).noise.sigma
        measured = {
            "position": windows.row_pos_w,
            "velocity": windows.row_vel_w,
            "rates": windows.row_rate_b,
        }
        of = np.asarray(windows.flight) == windows.flight[0]
        seen = np.asarray(windows.seen)[of]
        first = next(iter(simulated.values()))[of]

        def missed(group: str, axis: int) -> float:
            """Return the squared error beyond noise, over the variance of the motion."""
            at = SLICES[group].start + axis
            there = seen[..., at] & np.isfinite(first[..., at])
            if not there.any():
                return -np.inf
            error, motion = first[..., at][there], np.asarray(measured[group])[of][..., axis][there]
            noise = float(sigma[at]) ** 2
            return float(((error**2).mean() - 4.0 * noise) / max(float(motion.var()), noise))

        every = ((group, axis) for group in measured for axis in range(3))
        group, axis = max(every, key=lambda one: missed(*one))
        at = SLICES[group].start + axis
        time_s = (np.asarray(windows.start_s)[:, None] + np.asarray(windows.row_s))[of]
        value = np.where(seen[..., at], np.asarray(measured[group])[of][..., axis], np.nan)

        def line(values: np.ndarray) -> np.ndarray:
            """Return one line that breaks between rollouts."""
            return np.pad(values, ((0, 0), (0, 1)), constant_values=np.nan).ravel()

        frame = "body" if group == "rates" else "world"
        lines = {label: line(value - apart[of][..., at]) for label, apart in simulated.items()}
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
    """Return in words what the structure in a residual depends on; None where it is noise.

    Args:
        slow_errors: as `RolloutEvidence.slow_errors` has them.
        residual: the structure.
        rotor_input: whether measured rotor speeds are the input, whose noise is less certain.
        limits: above which structure is not noise.
    """
    slow, expected = slow_errors
    shape = residual.shapes[0] if residual.shapes else None
    if shape is not None and shape.p_value > limits.shape_p_value:
        shape = None
    coloured = [
        axis
        for axis, p_value in residual.coloured.items()
        if p_value <= limits.colour_p_value and not rotor_input
    ]
    least = limits.structure_rotor_input if rotor_input else limits.structure
    if not (shape or coloured or slow.sum() / expected.sum() > least):
        return None
    where = [shape.label] if shape else []
    for kind in ("force", "torque"):
        axes = [axis[-1] for axis in coloured if axis.startswith(kind)]
        if axes:
            where.append(f"a changing {kind} along body {', '.join(axes)}")
    return "; ".join(where) or _loudest(slow.sum(axis=0), expected.sum(axis=0))


def _loudest(slow: np.ndarray, expected: np.ndarray) -> str:
    """Return the channels with most energy (12,) beyond what is expected, in words."""
    energy = np.maximum(slow / np.maximum(expected, 1e-9) - 1.0, 0.0)
    loudest = [k for k in np.argsort(-energy)[:3] if energy[k] > 0]
    return "errors of " + ", ".join(f"{STATE_GROUPS[k // 3]} {'xyz'[k % 3]}" for k in loudest)


def late_by(found: SearchResult) -> dict[str, float]:
    """Return by named effect the delay of logged poses that it gives [s]."""
    values = found.judged.evidence.space.effects(found.estimate.theta)
    named = dict.fromkeys(candidate.name for candidate in found.candidates)
    return {name: float(lateness({name: values[name]})) for name in named if EFFECTS[name].late}
