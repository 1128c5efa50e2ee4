"""What an effect does on these flights, in units of practice, and what is too small to matter.

With little noise any difference is significant, the model's own small errors among them. What does
less than the thresholds of practical relevance is no finding, however small its p-value
(equivalence testing; Lakens 2017, doi 10.1177/1948550617697177): it is left out where the upper end
of the interval of its size is below all of them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from eval.effects import EFFECTS
from suite.diagnose.data.windows import SLICES, FlightWindows
from suite.diagnose.estimate.gauss_newton import gauss_newton_step
from suite.diagnose.evidence.rollouts import RolloutModel, weighed_by
from suite.diagnose.search.look import SearchResult, rollouts_of
from suite.diagnose.thresholds import Thresholds
from suite.diagnose.verdict.gap import Gap, measure

FORCE_S, TORQUE_S = 0.5, 0.1
"""Times over which an effect's mean acceleration is taken [s]: its turning is soon met by the rate
loop."""
DRIFT_S = 1.0
"""When its drift is looked at [s]."""


class EffectSize(NamedTuple):
    """RMS over a set of flights of what an effect does."""

    force: float
    """[m/s^2]."""
    torque: float
    """[rad/s^2]."""
    drift: float | None
    """Distance after a second [m]; None where no rollout was flown."""

    def relevant(self, limits: Thresholds) -> bool:
        """Return whether it reaches one of the thresholds."""
        force, torque, drift = limits.relevance
        return self.force >= force or self.torque >= torque or (self.drift or 0.0) >= drift

    def as_json(self) -> dict[str, float | None]:
        """Return the size as diagnosis.json has it."""
        return {"force": self.force, "torque": self.torque, "drift": self.drift}

    def words(self) -> str:
        """Return the size in a line."""
        drift = "" if self.drift is None else f", {self.drift:.2g} m after 1 s"
        return f"{self.force:.2g} m/s^2, {self.torque:.2g} rad/s^2{drift}"


def rollout_size(moved: np.ndarray, windows: FlightWindows) -> EffectSize:
    """Return the size of an effect that moves rollouts by `moved` (W, N, 19).

    A fault of the log alone moves what is logged as if something had moved the vehicle so far.
    """
    row_s, seen = np.asarray(windows.row_s), np.asarray(windows.seen)

    def by_time(group: str, horizon_s: float, power: int) -> float:
        """Return the RMS of what a group has moved at its last row within the horizon, per s^n."""
        there = seen[..., SLICES[group]].all(axis=-1) & (row_s <= horizon_s + 1e-6) & (row_s > 0.0)
        last = np.where(there, row_s, 0.0).argmax(axis=1)
        good = there.any(axis=1)
        if not good.any():
            return 0.0
        at = (np.arange(len(last))[good], last[good])
        over = moved[at][:, SLICES[group]] / row_s[at][:, None] ** power
        return float(np.sqrt((over**2).sum(axis=1).mean()))

    force = by_time("velocity", FORCE_S, 1) or 2.0 * by_time("position", FORCE_S, 2)
    felt = seen[..., SLICES["accelerometer"]].all(axis=-1)
    if felt.any():
        acc = moved[felt][:, SLICES["accelerometer"]]
        force = max(force, float(np.sqrt((acc**2).sum(axis=1).mean())))
    return EffectSize(force, by_time("rates", TORQUE_S, 1), by_time("position", DRIFT_S, 2))


def view_size(moved: np.ndarray, in_world: bool) -> EffectSize:
    """Return the size of an effect that changes a view's accelerations by `moved` (M, 3)."""
    rms = float(np.sqrt((moved**2).sum(axis=1).mean()))
    return EffectSize(rms, 0.0, None) if in_world else EffectSize(0.0, rms, None)


def sizes_of(
    slope: np.ndarray, away: np.ndarray, half_width: np.ndarray, windows: FlightWindows
) -> tuple[EffectSize, EffectSize]:
    """Return an effect's size, and the upper end of the size's interval.

    Args:
        slope: (W, N, 19, K) along its numbers.
        away: (K,) how far they are from the vehicle file's.
        half_width: (K,) of their 95 % intervals.
        windows: W of them.
    """
    size = rollout_size(slope @ away, windows)
    doubt = [rollout_size(slope[..., k] * width, windows) for k, width in enumerate(half_width)]
    wider = [float(np.sqrt(sum((one[i] or 0.0) ** 2 for one in doubt))) for i in range(3)]
    upper = EffectSize(*((size[i] or 0.0) + wider[i] for i in range(3)))
    return size, upper


def gap_matters(gap: Gap, count: int, limits: Thresholds) -> bool:
    """Return whether rollouts may be off by a relevant amount beyond what noise makes of them.

    The upper end of the 95 % interval counts; `count` rollouts overlap, so that as many are
    independent as fit side by side.
    """
    force, torque, drift = limits.relevance
    independent = max(count * limits.gap_stride_s, 1.0)
    wide = 1.0 + 1.96 / np.sqrt(2.0 * independent)

    def beyond(horizon_s: float, group: str) -> float:
        error, floor = gap.table[horizon_s][group]
        return float(np.sqrt(max((wide * error) ** 2 - floor**2, 0.0)))

    return bool(
        beyond(1.0, "position") >= drift
        or beyond(0.5, "velocity") >= FORCE_S * force
        or beyond(0.1, "rates") >= TORQUE_S * torque
    )


class Negligible(NamedTuple):
    """An effect that is significant and too small to matter."""

    name: str
    size: EffectSize


def relevant_part(
    model: RolloutModel,
    found: SearchResult,
    held: FlightWindows,
    gaps: tuple[Gap, Gap],
    limits: Thresholds,
    coarser: FlightWindows | None = None,
) -> tuple[SearchResult, Gap, dict[str, EffectSize], list[Negligible]]:
    """Return `found` without what does not matter on its flights.

    Where rollouts are surely off by less than matters before anything is named, only faults of the
    log may. Where measured rotor speeds drive, what the model's own error makes of an effect does
    not count: half of what every second rotor speed alone changes it by, where an error of second
    order would make a third (step doubling; Hairer, Norsett & Wanner 1993, Sec. II.4).

    Args:
        model: the rollout.
        found: what was found.
        held: windows that took no part.
        gaps: those on `held` before and after it was found.
        limits: from where on something matters.
        coarser: the fitted windows with every second rotor speed.

    Returns:
        What stays, its gap, the sizes of its effects by name, and what was left out.
    """
    (before, after), out = gaps, list[Negligible]()
    while found.named:
        sizes, upper = _sizes(model, found, coarser)
        none = not gap_matters(before, len(held.flight), limits)
        small = [
            name
            for name, most in upper.items()
            if (none and not EFFECTS[name].of_log) or not most.relevant(limits)
        ]
        if not small:
            return found, after, sizes, out
        out += [Negligible(name, sizes[name]) for name in small]
        kept = tuple(one for one in found.named if one.candidate.name not in small)
        if not kept:
            return found.refitted(()), before, {}, out
        found = found.refitted(kept)
        after = measure(model, found.estimate.theta, held, rollouts_of(found.last).noise, limits)
    return found, after, {}, out


def _sizes(
    model: RolloutModel, found: SearchResult, coarser: FlightWindows | None
) -> tuple[dict[str, EffectSize], dict[str, EffectSize]]:
    """Return the sizes of the named effects, and the upper ends of their intervals.

    In these the model's own error does not count.
    """
    estimate, windows, indices = found.estimate, rollouts_of(found.last).trusted, found.indices
    slope = model.linearise(estimate.theta, estimate.free, windows, indices).slope
    width, away, own = found.half_widths(), found.moved, np.zeros(len(indices))
    if coarser is not None:
        directions = [*indices, *model.starts]
        linear = model.linearise(estimate.theta, estimate.free, coarser, directions)
        how = (found.last.evidence.limits, rollouts_of(found.last).noise, indices)
        equations = weighed_by(model, coarser, linear, *how)[1].equations()
        own = 0.5 * np.abs(gauss_newton_step(equations, estimate.theta, model.space)[0])
    sizes, upper = {}, {}
    for name in dict.fromkeys(one.candidate.name for one in found.named):
        at = [k for k, i in enumerate(indices) if model.space.entries[i].effect == name]
        sizes[name], _ = sizes_of(slope[..., at], away[at], width[at], windows)
        sure = np.sign(away[at]) * np.maximum(np.abs(away[at]) - own[at], 0.0)
        upper[name] = sizes_of(slope[..., at], sure, width[at], windows)[1]
    return sizes, upper
