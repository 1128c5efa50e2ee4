"""The named effect beside a black box: on flights left out, and outside the speeds of the fit."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from eval.logs.flight_log import FlightLog
from suite.diagnose.checks.delta_model import BlackBoxConfig, black_box_gap, fit_black_box
from suite.diagnose.data.windows import LENGTH_S, FlightWindows, take
from suite.diagnose.estimate.gauss_newton import fit
from suite.diagnose.evidence.rollouts import start_estimate, weighed_by
from suite.diagnose.search.look import rollouts_of
from suite.diagnose.verdict.diagnosis import Diagnosis
from suite.diagnose.verdict.gap import Gap, measure


class BlackBoxComparison(NamedTuple):
    """The gap on windows that took no part in any fit."""

    judged_on: str
    """For people."""
    fitted: int
    """How many windows were fitted."""
    judged: int
    """How many the gap is of."""
    before: Gap
    named: Gap | None
    """With the named effects, fitted to the same windows as the black box; None without any."""
    black_box: Gap


@dataclass(frozen=True)
class BlackBoxComparisons:
    """Both comparisons."""

    held_out: BlackBoxComparison
    """On what the diagnosis held out."""
    outside: BlackBoxComparison | None
    """Fitted to slow windows, judged on fast ones; None where there are too few."""
    split_m_s: float
    """Speed between slow and fast [m/s]."""
    seconds: float
    """That it all took [s]."""


def compare_black_box(
    diagnosis: Diagnosis,
    config: BlackBoxConfig,
    progress: Callable[[float, str], None] = lambda *_: None,
) -> BlackBoxComparisons:
    """Fit the black box twice and hold it against what was named.

    `progress` is called with (share done, words).
    """
    began = time.monotonic()
    limits, search = diagnosis.limits, diagnosis.search
    model, held = diagnosis.model, diagnosis.held_windows
    noise = rollouts_of(search.last).noise

    def show(part: int) -> Callable[[int, str], None]:
        return lambda step, words: progress(0.5 * (part + step / config.iterations), words)

    known = _not_held_out(diagnosis.cut(limits.check_stride_s), held)
    params = fit_black_box(model, known, noise, config, show(0))
    held_out = BlackBoxComparison(
        judged_on="flights left out",
        fitted=len(known.flight),
        judged=len(held.flight),
        before=diagnosis.before,
        named=diagnosis.after if search.named else None,
        black_box=black_box_gap(model, params, held, noise, limits),
    )
    every = diagnosis.cut(LENGTH_S)
    top, mean = _speeds(diagnosis.logs, every)
    split = float(np.quantile(top, limits.slow_share))
    slow, fast = take(every, top <= split), take(every, mean > split)
    outside = None
    if min(len(slow.flight), len(fast.flight)) >= limits.least_judged:
        params = fit_black_box(model, slow, noise, replace(config, seed=config.seed + 1), show(1))
        named = None
        if search.named:
            start = start_estimate(model, slow)
            linear = model.linearise(start.theta, start.free, slow, None)
            evidence, block = weighed_by(model, slow, linear, limits, noise)
            best, _ = fit(evidence, start, search.indices, known=block, limits=limits)
            named = measure(model, best.theta, fast, noise, limits)
        outside = BlackBoxComparison(
            judged_on=f"speeds above {split:.1f} m/s, fitted below",
            fitted=len(slow.flight),
            judged=len(fast.flight),
            before=measure(model, diagnosis.start, fast, noise, limits),
            named=named,
            black_box=black_box_gap(model, params, fast, noise, limits),
        )
    return BlackBoxComparisons(held_out, outside, split, time.monotonic() - began)


def _not_held_out(windows: FlightWindows, held: FlightWindows) -> FlightWindows:
    """Return those of `windows` that do not touch what the diagnosis held out."""
    apart = ~np.isin(windows.flight, held.flight)
    if not apart.any():  # of a lone flight the end is left out
        apart = np.asarray(windows.start_s) + LENGTH_S <= float(np.min(held.start_s)) + 1e-6
    return take(windows, apart)


def _speeds(logs: Sequence[FlightLog], windows: FlightWindows) -> tuple[np.ndarray, np.ndarray]:
    """Return the top and the mean speed in each window (W,) [m/s]."""
    found = []
    for flight, start_s in zip(windows.flight, windows.start_s, strict=True):
        log = logs[int(flight)]
        time_s = log.time_s - log.time_s[0]
        inside = (time_s >= start_s - 1e-6) & (time_s <= start_s + LENGTH_S + 1e-6)
        speed = log.speed[inside]
        speed = speed[np.isfinite(speed)]
        found.append((speed.max(), speed.mean()))
    top, mean = np.array(found).T
    return top, mean
