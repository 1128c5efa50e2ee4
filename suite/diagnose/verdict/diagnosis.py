"""All that a diagnosis knows when it is done, and which of its names stand.

What held-out flights do not want is withdrawn, and so is what is too small to matter.

With little noise any difference is significant, the model's own small errors among them. What does
less than the thresholds of practical relevance is no finding, however small its p-value
(equivalence testing; Lakens 2017, doi 10.1177/1948550617697177): it is left out where the upper end
of the interval of its size is below all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from eval.effects import EFFECTS
from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.whitening import make_whitening
from suite.diagnose.data.windows import SLICES, FlightWindows, cut
from suite.diagnose.estimate.block import Estimate
from suite.diagnose.estimate.parameters import Candidate, ParameterSpace, effects_in, indices_of
from suite.diagnose.evidence.rollouts import RolloutModel, block_of
from suite.diagnose.search.look import NamedEffect, SearchResult, rollouts_of
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict.disturbances import Turbulence
from suite.diagnose.verdict.gap import HEADLINE_S, Gap, Verdict, measure, true_starts
from suite.diagnose.verdict.residual_structure import ResidualStructure


@dataclass(frozen=True)
class Diagnosis:
    """What was found, and what it was found from."""

    verdict: Verdict
    search: SearchResult
    half_width: dict[int, float]
    """Of the 95 % interval, by the place of each named number."""
    vehicle: Vehicle
    """With the named effects in place of what the nominal one has of them."""
    before: Gap
    after: Gap
    without: dict[str, Gap]
    """By a named effect's label: the gap with all others."""
    control: tuple[str, Gap] | None
    """A wrong effect fitted in the same way, and its gap."""
    residual: ResidualStructure
    """Structure in what the named effects leave."""
    turbulence: Turbulence | None
    logs: Sequence[FlightLog]
    nominal: Vehicle
    """The vehicle that the simulation used."""
    rotor_input: bool
    """Whether measured rotor speeds were the model's input, not the commands."""
    sizes: dict[str, EffectSize]
    """What each named effect does on these flights, by its name."""
    negligible: list[Negligible]
    """What is significant and too small to matter."""
    held_out: list[str]
    """Names of what took no part in finding or fitting anything."""
    held_windows: FlightWindows
    """Overlapping windows over it."""
    model: RolloutModel
    """Of the nominal vehicle."""
    seconds: float
    warnings: list[str]
    seed: int
    """Of all draws."""
    limits: Thresholds = THRESHOLDS

    @property
    def label(self) -> str:
        """no_gap, named, partly or unknown."""
        return self.verdict.label

    @property
    def results(self) -> tuple[Diagnosis]:
        """What each kind of evidence found: here one did."""
        return (self,)

    @property
    def names(self) -> tuple[NamedEffect, ...]:
        """Every name that stands."""
        return self.search.named

    @property
    def named(self) -> list[tuple[Diagnosis, NamedEffect]]:
        """Every name that stands, with what found it."""
        return [(self, name) for name in self.search.named]

    @property
    def space(self) -> ParameterSpace:
        """The catalogue's numbers."""
        return self.model.space

    def removed(self, names: Sequence[NamedEffect]) -> float:
        """Return the share of the gap that `names`, of one effect, take away when added last."""
        without = max(self.without[one.candidate.label].rms for one in names)
        return (without - self.after.rms) / max(self.before.rms - 1.0, 1e-9)

    def size(self, names: Sequence[NamedEffect]) -> tuple[EffectSize]:
        """Return what `names`, of one effect, do on these flights."""
        return (self.sizes[names[0].candidate.name],)

    @property
    def sigma(self) -> np.ndarray:
        """(19,) measurement noise of each channel in its unit; NaN where nothing was measured."""
        return rollouts_of(self.search.last).noise.sigma

    @property
    def input_source(self) -> str:
        """What the model's input was, for people."""
        return "measured rotor speeds" if self.rotor_input else "commands"

    @property
    def start(self) -> np.ndarray:
        """Return the numbers (P,) of the vehicle file."""
        return self.model.space.array("start")

    @property
    def fitted(self) -> np.ndarray | None:
        """Return the numbers (P,) with what was named; None where nothing was."""
        return self.search.estimate.theta if self.search.named else None

    def cut(self, stride_s: float, only: Sequence[int] | None = None) -> FlightWindows:
        """Return windows of all flights or of `only` some, one every `stride_s` [s]."""
        how = (self.rotor_input, stride_s, self.limits, self.model.integrator)
        windows, _ = cut(self.logs, self.nominal, *how, only=only)
        assert windows is not None  # the diagnosis has cut them before
        return windows


def confirmed(
    model: RolloutModel,
    found: SearchResult,
    held: FlightWindows,
    gaps: tuple[Gap, Gap],
    limits: Thresholds,
) -> tuple[SearchResult, Gap, dict[str, Gap], list[str]]:
    """Return `found` without the names that do not lower the gap on held-out flights.

    Where the model stays off the noise floor, what it lacks lends a part of itself to any number:
    a name has to lower the gap by a share of what is left then. A name stays where these flights
    could not show it, as those that keep off the ground cannot show its effect. `gaps` are those
    before and after it was found.

    Returns:
        What stays, its gap, the gaps without each of its names, and the labels of what went.
    """
    (before, after), gone = gaps, list[str]()
    while found.named:
        without = _without_each(model, found, held, limits)
        # Of the mean score, 1 is noise and all else what no name explains.
        rest = max(0.0, 1.0 - 1.0 / after.score.mean()) if rollouts_of(found.judged).off else 0.0
        doubted = [
            one
            for one in found.candidates
            if without[one.label].energy.sum()
            <= (1.0 + limits.least_beside_rest * rest) * after.energy.sum()
            and _shown(model, found, one, held, limits)
        ]
        if not doubted:
            return found, after, without, gone
        label = min((one.label for one in doubted), key=lambda k: float(without[k].energy.sum()))
        gone.append(label)
        kept = tuple(one for one in found.named if one.candidate.label != label)
        if kept:
            found = found.refitted(kept)
            kept = _acting(found)
        if not kept:
            return found.refitted(()), before, {}, gone
        if len(kept) < len(found.named):
            gone += [one.candidate.label for one in found.named if one not in kept]
            found = found.refitted(kept)
        after = measure(model, found.estimate.theta, held, rollouts_of(found.last).noise, limits)
    return found, after, {}, gone


def control(
    model: RolloutModel, found: SearchResult, held: FlightWindows, limits: Thresholds
) -> tuple[str, Gap] | None:
    """Return the best effect that is neither named nor a rival, fitted alone, and its gap."""
    taken = {candidate.name for candidate in found.candidates}
    taken |= {name for one in found.named for rival in one.rivals for name in effects_in(rival)}
    among = (s.candidate for s in found.first if not s.candidate.parts)
    wrong = next((one for one in among if one.name not in taken), None)
    if wrong is None:
        return None
    theta = found.fitted_anew(found.start, list(wrong.indices)).theta
    return wrong.label, measure(model, theta, held, rollouts_of(found.last).noise, limits)


def _acting(found: SearchResult) -> tuple[NamedEffect, ...]:
    """Return the names of `found` that do something: a wind without its drag does not."""
    told = np.einsum("wkk->k", found.judged.equations.along_numbers(found.indices).hessian)
    at = {index: told[k] for k, index in enumerate(found.indices)}
    return tuple(
        one for one in found.named if any(at[index] > 0.0 for index in one.candidate.indices)
    )


def _shown(
    model: RolloutModel,
    found: SearchResult,
    one: Candidate,
    held: FlightWindows,
    limits: Thresholds,
) -> bool:
    """Return whether held-out flights would show the effect at the size that was fitted."""
    theta, own = found.estimate.theta, list(one.indices)
    offset = true_starts(model, theta, held)
    linear = model.linearise(theta, offset, held, [*own, *model.starts])
    whitening = make_whitening(linear, rollouts_of(found.last).noise, held, limits)
    slope = block_of(whitening, linear, own, held).slope
    moved = theta[own] - model.space.array("start")[own]
    # Windows overlap: each row of the log counts this often.
    expected = float(((slope @ moved) ** 2).sum()) * limits.gap_stride_s / HEADLINE_S
    return bool(expected > limits.shown_chi2)


def _without_each(
    model: RolloutModel, found: SearchResult, held: FlightWindows, limits: Thresholds
) -> dict[str, Gap]:
    """Return by label of each name the gap where all others are fitted without it."""
    start, gaps = model.space.array("start"), {}
    for one in found.candidates:
        others = [candidate for candidate in found.candidates if candidate is not one]
        theta = start
        if others:
            theta = found.estimate.theta.copy()
            theta[list(one.indices)] = start[list(one.indices)]
            without = Estimate(theta, found.estimate.free)
            theta = found.fitted_anew(without, indices_of(others)).theta
        gaps[one.label] = measure(model, theta, held, rollouts_of(found.last).noise, limits)
    return gaps


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
) -> tuple[SearchResult, Gap, dict[str, EffectSize], list[Negligible]]:
    """Return `found` without what does not matter on its flights.

    `gaps` on the windows `held` are those before and after it was found. Where rollouts are surely
    off by less than matters before anything is named, only faults of the log may.

    Returns:
        What stays, its gap, the sizes of its effects by name, and what was left out.
    """
    (before, after), out = gaps, list[Negligible]()
    while found.named:
        sizes, upper = _sizes(model, found)
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
    model: RolloutModel, found: SearchResult
) -> tuple[dict[str, EffectSize], dict[str, EffectSize]]:
    """Return the sizes of the named effects, and the upper ends of their intervals."""
    estimate, windows, indices = found.estimate, rollouts_of(found.last).trusted, found.indices
    slope = model.linearise(estimate.theta, estimate.free, windows, indices).slope
    width, away = found.half_widths(), found.moved
    sizes, upper = {}, {}
    for name in dict.fromkeys(one.candidate.name for one in found.named):
        at = [k for k, i in enumerate(indices) if model.space.entries[i].effect == name]
        sizes[name], upper[name] = sizes_of(slope[..., at], away[at], width[at], windows)
    return sizes, upper
