"""The named effect beside a black box: on flights left out, and outside the speeds of the fit."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.windows import LENGTH_S, Windows, cut, take
from suite.diagnose.diagnose import Diagnosis
from suite.diagnose.fit.normal_equations import fit, make_frame
from suite.diagnose.fit.search import start_state
from suite.diagnose.verdict.delta_model import BlackBoxConfig, black_box_gap, fit_black_box
from suite.diagnose.verdict.gap import Gap, measure

SLOW = 0.6
"""Share of the stretches, the slowest, that are fitted where the fast ones judge."""
LEAST = 6
"""Stretches to fit and to judge, at least."""
STRIDE_S = 0.5
"""From one fitted stretch to the next where flights are left out [s]."""


class Contest(NamedTuple):
    """The gap on stretches that took no part in any fit."""

    judged_on: str
    """For people."""
    fitted: int
    """Stretches."""
    judged: int
    before: Gap
    named: Gap | None
    """With the named effects, fitted to the same stretches as the black box; None without any."""
    black_box: Gap


@dataclass(frozen=True)
class Contests:
    """Both comparisons."""

    held_out: Contest
    """The split of the diagnosis."""
    outside: Contest | None
    """Fitted to slow stretches, judged on fast ones; None where there are too few."""
    split_m_s: float
    """Speed between slow and fast [m/s]."""
    seconds: float
    """That it all took [s]."""


def compare_black_box(
    result: Diagnosis,
    logs: Sequence[FlightLog],
    vehicle: Vehicle,
    config: BlackBoxConfig,
    progress: Callable[[float, str], None] = lambda *_: None,
) -> Contests:
    """Fit the black box twice and hold it against what was named.

    Args:
        result: the diagnosis of `logs`.
        logs: the flights.
        vehicle: the one that the simulation used.
        config: of the black box's fits.
        progress: called with (share done, words).
    """
    began = time.monotonic()
    model, sigma = result.model, result.finding.sigma
    by_rotors = result.driven_by != "commands"
    begin = model.space.array("start")

    def show(part: int) -> Callable[[int, str], None]:
        return lambda step, words: progress(0.5 * (part + step / config.iterations), words)

    known = _known(result, _windows(logs, vehicle, by_rotors, STRIDE_S))
    params = fit_black_box(model, known, sigma, config, show(0))
    held_out = Contest(
        judged_on="flights left out",
        fitted=len(known.flight),
        judged=len(result.held.flight),
        before=result.before,
        named=result.after if result.finding.named else None,
        black_box=black_box_gap(model, params, result.held, sigma),
    )
    every = _windows(logs, vehicle, by_rotors, LENGTH_S)
    top, mean = _speeds(logs, every)
    split = float(np.quantile(top, SLOW))
    slow, fast = take(every, top <= split), take(every, mean > split)
    outside = None
    if min(len(slow.flight), len(fast.flight)) >= LEAST:
        params = fit_black_box(model, slow, sigma, replace(config, seed=config.seed + 1), show(1))
        named = None
        if result.finding.named:
            state = start_state(model, slow)
            linear = model.linearise(state.theta, state.offset, slow, model.starts)
            frame = make_frame(linear, sigma, slow)
            theta = fit(model, slow, frame, state, result.finding.indices)[0].theta
            named = measure(model, theta, fast, sigma)
        outside = Contest(
            judged_on=f"speeds above {split:.1f} m/s, fitted below",
            fitted=len(slow.flight),
            judged=len(fast.flight),
            before=measure(model, begin, fast, sigma),
            named=named,
            black_box=black_box_gap(model, params, fast, sigma),
        )
    return Contests(held_out, outside, split, time.monotonic() - began)


def _windows(
    logs: Sequence[FlightLog], vehicle: Vehicle, by_rotors: bool, stride_s: float
) -> Windows:
    windows, _ = cut(logs, vehicle, by_rotors, stride_s)
    assert windows is not None  # the diagnosis has cut them before
    return windows


def _known(result: Diagnosis, windows: Windows) -> Windows:
    """Return those of `windows` that do not touch what the diagnosis left out."""
    held = result.held
    apart = ~np.isin(windows.flight, held.flight)
    if not apart.any():  # of a lone flight the end is left out
        apart = np.asarray(windows.start_s) + LENGTH_S <= float(np.min(held.start_s)) + 1e-6
    return take(windows, apart)


def _speeds(logs: Sequence[FlightLog], windows: Windows) -> tuple[np.ndarray, np.ndarray]:
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
