"""The search: one effect after another, each against the null, then every name against its rivals.

What is named must lower the error on windows left out by more than the best of all candidates does
on data with shuffled signs. A rival that explains the same windows as well is an alternative.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from suite.diagnose.evidence import Frame, State, Sums, fit, make_frame, sums_of
from suite.diagnose.model import Model
from suite.diagnose.noise import noise_of
from suite.diagnose.parameters import Candidate, indices_of
from suite.diagnose.select import Score, folds_of, score
from suite.diagnose.windows import Windows

P_VALUE = 0.01
"""Chance of a false name at each step of the search."""
MOST = 4
"""Effects that are named at most."""
LEAST_SHARE = 0.003
"""An effect that explains less than this share of what the first one did is not named: the fit of
the first, which is not exact, leaves so much."""
SHORT = 5
"""Candidates that are fitted through the whole model at a step."""
NEAR = 0.5
"""Candidates whose linear gain is less than this share of the best are not fitted so."""
RIVAL_ERRORS = 2.0
"""A rival within this many standard errors of the difference cannot be told apart."""


@dataclass
class Named:
    """One effect that was named."""

    candidate: Candidate
    p_value: float = 1.0
    gain: float = 0.0
    """Fall of the error when it is added last."""
    rivals: list[str] = field(default_factory=list)
    """Names that explain the same."""


@dataclass
class Finding:
    """What a search found."""

    named: list[Named]
    state: State
    sums: Sums
    """Along the named numbers, at the end."""
    indices: list[int]
    sigma: np.ndarray
    frame: Frame
    first: list[Score]
    """Scores of all candidates before anything was named."""
    slow_before: np.ndarray
    """(W, 12) slow errors before, over their expectation."""
    slow_after: np.ndarray


def start_state(model: Model, windows: Windows) -> State:
    """Return the vehicle file's numbers and the measured starts."""
    return State(model.space.array("start"), np.zeros((len(windows.flight), model.free)))


def search(
    model: Model, windows: Windows, among: Sequence[Candidate], say: Callable[[str], None]
) -> Finding:
    """Return what explains the gap between `model` and `windows`."""
    fold = folds_of(np.asarray(windows.flight), np.asarray(windows.start_s))
    state = start_state(model, windows)
    named: list[Named] = []
    first: list[Score] = []
    slow_before = np.zeros(0)
    while True:
        frame, sums, sigma, state = _look(model, windows, state)
        indices = indices_of([n.candidate for n in named])
        left = [c for c in among if not set(c.indices) & set(indices)]
        scores = score(sums, state.theta, model.space, indices, left, fold)
        if not first:
            first, slow_before = scores, sums.slow / frame.slow_freedom
        best = scores[0] if scores else None
        enough = best and best.p_value <= P_VALUE and best.gain > LEAST_SHARE * first[0].gain
        if best is None or not enough or len(named) >= MOST:
            break
        short = [s for s in scores if s.gain >= NEAR * best.gain][:SHORT]
        tried = []
        for item in short:
            at = indices_of([*(n.candidate for n in named), item.candidate])
            after, fitted = fit(model, windows, frame, state, at)
            tried.append((float(fitted.error.sum()) + 2 * len(at), item, after))
            say(f"{item.candidate.label}: {float(sums.error.sum() - fitted.error.sum()):.0f}")
        _, item, state = min(tried, key=lambda t: t[0])
        named.append(Named(item.candidate, item.p_value, item.gain))
    state, last = fit(model, windows, frame, state, indices) if indices else (state, sums)
    _judge_rivals(model, windows, frame, named, state, last, among, fold, say)
    indices = indices_of([n.candidate for n in named])
    state, last = fit(model, windows, frame, state, indices, rounds=3 if indices else 0)
    after = last.slow / frame.slow_freedom
    return Finding(named, state, last, indices, sigma, frame, first, slow_before, after)


def _look(model: Model, windows: Windows, state: State) -> tuple[Frame, Sums, np.ndarray, State]:
    linear = model.linearise(state.theta, state.offset, windows, None)
    sigma = noise_of(linear.residual, windows)
    frame = make_frame(linear, sigma, windows)
    return frame, sums_of(frame, linear, model.size), sigma, state


def _judge_rivals(
    model: Model,
    windows: Windows,
    frame: Frame,
    named: list[Named],
    state: State,
    last: Sums,
    among: Sequence[Candidate],
    fold: np.ndarray,
    say: Callable[[str], None],
) -> None:
    """Set each name's evidence when added last, and its rivals; a better rival takes its place."""
    begin = model.space.array("start")
    for one in list(named):
        others = [n.candidate for n in named if n is not one]
        without_theta = state.theta.copy()
        without_theta[list(one.candidate.indices)] = begin[list(one.candidate.indices)]
        at = indices_of(others)
        without, _ = fit(model, windows, frame, State(without_theta, state.offset), at)
        linear = model.linearise(without.theta, without.offset, windows, None)
        sums = sums_of(frame, linear, model.size)
        left = [c for c in among if not set(c.indices) & set(at)]
        scores = score(sums, without.theta, model.space, at, left, fold)
        own = next((s for s in scores if s.candidate == one.candidate), None)
        if own is not None:
            one.p_value, one.gain = own.p_value, own.gain
        best_error, best = last.error, one.candidate
        fitted = []
        for item in [s for s in scores if s.candidate != one.candidate][:SHORT]:
            if item.gain < NEAR * one.gain:
                continue
            chosen = indices_of([*others, item.candidate])
            after, sums_after = fit(model, windows, frame, without, chosen)
            fitted.append((item.candidate, sums_after.error))
            if sums_after.error.sum() + 2 * len(chosen) < best_error.sum() + 2 * len(
                indices_of([*others, best])
            ):
                best_error, best, state = sums_after.error, item.candidate, after
                last = sums_after
            say(f"{one.candidate.label} or {item.candidate.label}: "
                f"{float(sums_after.error.sum() - best_error.sum()):.1f}")  # fmt: skip
        if best != one.candidate:
            fitted.append((one.candidate, last.error))
            one.candidate = best
        size = len(best.indices)
        one.rivals = []
        for candidate, error in fitted:
            apart = error - best_error
            total = float(apart.sum()) + 2 * (len(candidate.indices) - size)
            spread = float(np.sqrt(len(apart)) * np.std(apart))
            same = candidate.name == best.name or candidate.name in one.rivals
            if candidate != best and not same and total <= RIVAL_ERRORS * spread:
                one.rivals.append(candidate.name)
