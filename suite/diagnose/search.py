"""The search: one effect after another, each against the null, then every name against its rivals.

What is named must lower the error on windows left out by more than the best of all candidates does
on data with shuffled signs. A rival that explains the same windows as well is an alternative.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from suite.diagnose.evidence import Frame, State, Sums, fit, make_frame, solve, sums_of
from suite.diagnose.model import Linear, Model
from suite.diagnose.noise import noise_of
from suite.diagnose.parameters import Candidate, Space, indices_of
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
APART = 9.0
"""A rival whose squared error, in units of the noise, is less than this above that of the name
(three sigma) cannot be told from it."""
MOSTLY = 0.25
"""Nor can one that leaves less than this share of what the name explains, where that is little."""
ROUNDS = 3
"""Times that names and rivals are weighed anew."""
LOOK = 25.0
"""A candidate that is worse than the best by more than this to first order is not fitted."""
BENT = 0.1
"""Nor one that is worse by more than this share besides: large effects are not of first order."""


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
    slow_after: np.ndarray
    """(W, 12) energy of slow errors that are left; `frame.slow_freedom` is what noise gives."""
    explained: float
    """Fall of the squared error, in units of the noise, that the named effects bring."""


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
    while True:
        linear, frame, sums, sigma = _look(model, windows, state)
        indices = indices_of([n.candidate for n in named])
        left = [c for c in among if not set(c.indices) & set(indices)]
        scores = score(sums, state.theta, model.space, indices, left, fold)
        if not first:
            first = scores
        best = scores[0] if scores else None
        enough = best and best.p_value <= P_VALUE and best.gain > LEAST_SHARE * first[0].gain
        if best is None or not enough or len(named) >= MOST:
            break
        tried = []
        fallen = {
            s.candidate: _fallen(sums, state.theta, model.space, indices, s.candidate)
            for s in scores
            if s.gain >= NEAR * best.gain
        }
        short = [s for s in scores if _near(fallen, s.candidate)][:SHORT]
        for item in short:
            at = indices_of([*(n.candidate for n in named), item.candidate])
            after, fitted = fit(model, windows, frame, state, at, known=linear)
            tried.append((float(fitted.error.sum()) + 2 * len(at), item, after))
            say(f"{item.candidate.label}: {float(sums.error.sum() - fitted.error.sum()):.0f}")
        _, item, state = min(tried, key=lambda t: t[0])
        named.append(Named(item.candidate, item.p_value, item.gain))
    named, state = _settle(model, windows, frame, named, state, among, fold, say)
    indices = indices_of([n.candidate for n in named])
    state, last = fit(model, windows, frame, state, indices, rounds=3 if indices else 0)
    begin = fit(model, windows, frame, start_state(model, windows), [])[1] if indices else last
    explained = float(begin.error.sum() - last.error.sum())
    return Finding(named, state, last, indices, sigma, frame, first, last.slow, explained)


def _settle(
    model: Model,
    windows: Windows,
    frame: Frame,
    named: list[Named],
    state: State,
    among: Sequence[Candidate],
    fold: np.ndarray,
    say: Callable[[str], None],
) -> tuple[list[Named], State]:
    """Refit all names jointly and judge each against its rivals, until no name changes."""
    for _ in range(ROUNDS):
        indices = indices_of([n.candidate for n in named])
        if not indices:
            break
        state, last = fit(model, windows, frame, state, indices)
        before = [n.candidate for n in named]
        state = _judge_rivals(model, windows, frame, named, state, last, among, fold, say)
        needed = [n for n in named if n.p_value <= P_VALUE]
        if [n.candidate for n in needed] == before:
            break
        # A name that was taken on the way may be needed no more beside better ones.
        theta, begin = state.theta.copy(), model.space.array("start")
        for one in named:
            if one not in needed:
                theta[list(one.candidate.indices)] = begin[list(one.candidate.indices)]
        named, state = needed, State(theta, state.offset)
    return named, state


def _look(model: Model, windows: Windows, state: State) -> tuple[Linear, Frame, Sums, np.ndarray]:
    """Return the slopes along everything at `state`, their frame and sums, and the noise."""
    linear = model.linearise(state.theta, state.offset, windows, None)
    sigma = noise_of(linear.residual, windows)
    frame = make_frame(linear, sigma, windows)
    return linear, frame, sums_of(frame, linear, model.size), sigma


def _near(fallen: Mapping[Candidate, float], candidate: Candidate) -> bool:
    """Return whether `candidate` could be the best: slopes alone say too little of large effects.

    Args:
        fallen: fall of the error to first order, by candidate.
        candidate: one of them, or any other.
    """
    most = max(fallen.values())
    return fallen.get(candidate, -np.inf) >= most - LOOK - BENT * abs(most)


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
) -> State:
    """Set each name's evidence when added last, and its rivals; a better rival takes its place."""
    begin = model.space.array("start")
    for one in list(named):
        others = [n.candidate for n in named if n is not one]
        without_theta = state.theta.copy()
        without_theta[list(one.candidate.indices)] = begin[list(one.candidate.indices)]
        at = indices_of(others)
        without, bare = fit(model, windows, frame, State(without_theta, state.offset), at)
        linear = model.linearise(without.theta, without.offset, windows, None)
        sums = sums_of(frame, linear, model.size)
        left = [c for c in among if not set(c.indices) & set(at)]
        scores = score(sums, without.theta, model.space, at, left, fold)
        own = next((s for s in scores if s.candidate == one.candidate), None)
        if own is not None:
            one.p_value, one.gain = own.p_value, own.gain
        # (candidate, error with it in place of the name, what it costs in numbers)
        tried = [(one.candidate, float(last.error.sum()), state, last)]
        fallen = {c: _fallen(sums, without.theta, model.space, at, c) for c in left}
        for candidate in left:
            if candidate == one.candidate or not _near(fallen, candidate):
                continue
            chosen = indices_of([*others, candidate])
            after, sums_after = fit(model, windows, frame, without, chosen, known=linear)
            tried.append((candidate, float(sums_after.error.sum()), after, sums_after))
            say(f"{one.candidate.label} or {candidate.label}: {tried[-1][1] - tried[0][1]:.1f}")
        cost = {c.label: error + len(c.indices) for c, error, _, _ in tried}
        best, error, state, last = min(tried, key=lambda t: cost[t[0].label])
        if best != one.candidate:
            one.p_value = next(s.p_value for s in scores if s.candidate == best)
        explained = float(bare.error.sum()) - error
        limit = min(APART, MOSTLY * explained)
        one.candidate = best
        names = [c.name for c, *_ in tried if cost[c.label] - cost[best.label] <= limit]
        one.rivals = [name for name in dict.fromkeys(names) if name != best.name]
    return state


def _fallen(
    sums: Sums, theta: np.ndarray, space: Space, at: Sequence[int], candidate: Candidate
) -> float:
    """Return the fall of the error, to first order, where `candidate` joins the numbers `at`."""
    columns = indices_of([candidate]) if not at else sorted({*at, *candidate.indices})
    square = sums.square[:, columns][:, :, columns].sum(0)
    cross = sums.cross[:, columns].sum(0)
    low, high, scale = (space.array(name)[columns] for name in ("low", "high", "step"))
    if np.trace(square) < 1e-12:
        return 0.0
    change = solve(square, cross, low - theta[columns], high - theta[columns], scale)
    return float(2 * cross @ change - change @ square @ change)
