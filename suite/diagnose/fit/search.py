"""The search: one effect after another, each against the null, then every name against its rivals.

What is named must lower the error on windows left out by more than the best of all candidates does
on data with shuffled signs. A rival that explains the same windows as well is an alternative.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from suite.diagnose.data.noise import noise_of
from suite.diagnose.data.windows import SLICES, Windows
from suite.diagnose.fit.model import Linear, Model
from suite.diagnose.fit.normal_equations import Frame, State, Sums, fit, make_frame, solve, sums_of
from suite.diagnose.fit.parameters import Candidate, Space, indices_of
from suite.diagnose.fit.permutation import Score, folds_of, score

P_VALUE = 0.001
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
HORIZONS_S = (1.0, 0.5, 0.25)
"""Lengths of a window, of which the longest is taken that it can be trusted for [s]."""
LOST_M = 0.15
"""Error of position from which slopes are not trusted [m]."""
LOST_HEIGHT = 0.25
"""The same for height, as a share of it: near the ground the air changes with it [1]."""
LOST_RAD = 0.25
"""The same for attitude [rad]."""
LAST_ROUNDS = 10
"""Steps of the last fit of all names: some effects saturate."""
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
    apart: dict[str, float] = field(default_factory=dict)
    """By label of what was fitted in its place: by how much it is worse, in units of the noise and
    with a unit for each number."""


@dataclass
class Finding:
    """What a search found."""

    named: list[Named]
    windows: Windows
    """What was fitted, as long as the model could be trusted."""
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
    model: Model,
    windows: Windows,
    among: Sequence[Candidate],
    say: Callable[[str], None],
    known: Linear | None = None,
    seed: int = 0,
) -> Finding:
    """Return what explains the gap between `model` and `windows`.

    Args:
        model: of the windows.
        windows: what is fitted.
        among: the candidates.
        say: told of the steps.
        known: slopes along everything at the vehicle file's numbers, where they are known.
        seed: of the null's draws.
    """
    whole, fold = windows, folds_of(np.asarray(windows.flight), np.asarray(windows.start_s))
    state = start_state(model, windows)
    named: list[Named] = []
    first: list[Score] = []
    while True:
        linear, windows, frame, sums, sigma = _look(model, whole, state, None if named else known)
        indices = indices_of([n.candidate for n in named])
        left = [c for c in among if not set(c.indices) & set(indices)]
        scores = score(sums, state.theta, model.space, indices, left, fold, seed)
        if not first:
            first = scores
        best = scores[0] if scores else None
        enough = best and best.p_value <= P_VALUE and best.gain > LEAST_SHARE * first[0].gain
        if best is None or not enough or len(named) >= MOST:
            break
        tried = []
        fallen = {
            s.candidate: _fallen(sums, state.theta, model.space, [*indices, *s.candidate.indices])
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
    named, state = _settle(model, whole, windows, frame, named, state, among, fold, say, seed)
    indices = indices_of([n.candidate for n in named])
    state, last = fit(model, windows, frame, state, indices, LAST_ROUNDS if indices else 0)
    begin = fit(model, windows, frame, start_state(model, windows), [])[1] if indices else last
    explained = float(begin.error.sum() - last.error.sum())
    return Finding(named, windows, state, last, indices, sigma, frame, first, last.slow, explained)


def _settle(
    model: Model,
    whole: Windows,
    windows: Windows,
    frame: Frame,
    named: list[Named],
    state: State,
    among: Sequence[Candidate],
    fold: np.ndarray,
    say: Callable[[str], None],
    seed: int,
) -> tuple[list[Named], State]:
    """Refit all names jointly and judge each against its rivals, until no name changes.

    Args:
        model: of the windows.
        whole: windows at full length.
        windows: as long as the model with all names can be trusted.
        frame: of these.
        named: what was named.
        state: with it.
        among: the candidates.
        fold: (W,) windows of one number are left out together.
        say: told of the steps.
        seed: of the null's draws.
    """
    for _ in range(ROUNDS):
        indices = indices_of([n.candidate for n in named])
        if not indices:
            break
        state, _ = fit(model, windows, frame, state, indices)
        before = [n.candidate for n in named]
        state = _judge_rivals(model, whole, named, state, among, fold, say, seed)
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


def _look(
    model: Model, windows: Windows, state: State, known: Linear | None
) -> tuple[Linear, Windows, Frame, Sums, np.ndarray]:
    """Return the slopes along everything at `state`, and how to weigh them.

    With them come the windows, as long as slopes can be trusted, their frame and sums, and the
    noise.
    """
    linear = known
    if linear is None:
        linear = model.linearise(state.theta, state.offset, windows, None)
    sigma = noise_of(linear.residual, windows)
    view = trusted(windows, linear.residual)
    frame = make_frame(linear, sigma, view)
    return linear, view, frame, sums_of(frame, linear, model.size), sigma


def trusted(windows: Windows, residual: np.ndarray) -> Windows:
    """Return `windows`, each up to where the model has not left the flight by too much.

    Beyond, slopes taken where the model is say nothing of where the flight was: it may have turned
    over, or sunk below the ground. What is named brings the model back, and the next look is
    longer.
    """
    apart = np.abs(residual)
    height = np.maximum(np.asarray(windows.row_pos_w)[..., 2], 0.0)
    lost = (apart[..., SLICES["position"]].max(axis=-1) > LOST_M) | (
        apart[..., SLICES["attitude"]].max(axis=-1) > LOST_RAD
    )
    lost |= (apart[..., 2] > LOST_HEIGHT * height) & (height > 0.0)
    row_s = np.asarray(windows.row_s)
    trusted = np.full(len(row_s), HORIZONS_S[-1])
    for horizon in reversed(HORIZONS_S):
        there = ~(lost & (row_s <= horizon)).any(axis=1)
        trusted = np.where(there, horizon, trusted)
    seen = np.asarray(windows.seen) & (row_s <= trusted[:, None] + 1e-9)[..., None]
    return windows._replace(seen=seen)


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
    named: list[Named],
    state: State,
    among: Sequence[Candidate],
    fold: np.ndarray,
    say: Callable[[str], None],
    seed: int,
) -> State:
    """Set each name's evidence when added last, and its rivals; a better rival takes its place."""
    begin = model.space.array("start")
    for one in list(named):
        others = [n.candidate for n in named if n is not one]
        theta = state.theta.copy()
        theta[list(one.candidate.indices)] = begin[list(one.candidate.indices)]
        without = State(theta, state.offset)
        linear, view, frame, sums, _ = _look(model, windows, without, None)
        at = indices_of(others)
        left = [c for c in among if not set(c.indices) & set(at)]
        scores = score(sums, theta, model.space, at, left, fold, seed)
        own = next((s for s in scores if s.candidate == one.candidate), None)
        if own is not None:
            one.p_value, one.gain = own.p_value, own.gain
        fallen = {c: _fallen(sums, theta, model.space, [*at, *c.indices]) for c in left}
        tried = []
        for candidate in left:
            if candidate == one.candidate or _near(fallen, candidate):
                chosen = indices_of([*others, candidate])
                after, fitted = fit(model, view, frame, without, chosen, known=linear)
                tried.append((float(fitted.error.sum()) + len(candidate.indices), candidate, after))
                say(f"{one.candidate.label} or {candidate.label}: {tried[-1][0]:.1f}")
        least, best, state = min(tried, key=lambda t: t[0])
        if best != one.candidate:
            one.p_value = next(s.p_value for s in scores if s.candidate == best)
        explained = float(sums.error.sum()) - _fallen(sums, theta, model.space, at) - least
        limit = min(APART, MOSTLY * explained)
        one.candidate = best
        one.apart = {c.label: cost - least for cost, c, _ in tried if c != best}
        names = [c.name for cost, c, _ in tried if cost - least <= limit]
        one.rivals = [name for name in dict.fromkeys(names) if name != best.name]
    return state


def _fallen(sums: Sums, theta: np.ndarray, space: Space, columns: Sequence[int]) -> float:
    """Return the fall of the error, to first order, where the numbers at `columns` are fitted."""
    columns = sorted(set(columns))
    square = sums.square[:, columns][:, :, columns].sum(0)
    cross = sums.cross[:, columns].sum(0)
    low, high, scale = (space.array(name)[columns] for name in ("low", "high", "step"))
    if not columns or np.trace(square) < 1e-12:
        return 0.0
    change = solve(square, cross, low - theta[columns], high - theta[columns], scale)
    return float(2 * cross @ change - change @ square @ change)
