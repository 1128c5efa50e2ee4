"""Whether a fitted effect has a size that real vehicles have."""

from __future__ import annotations

import numpy as np

from eval.effects import EFFECTS
from eval.effects.interface import Parameter
from suite.diagnose.estimate.parameters import Candidate, FittedNumber, ParameterSpace
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


def implausible(
    space: ParameterSpace,
    theta: np.ndarray,
    candidate: Candidate,
    limits: Thresholds = THRESHOLDS,
) -> list[str]:
    """Return the numbers of `candidate` that are beyond their usual size at `theta` (P,), in words.

    Usual is what the catalogue has as the upper usual magnitude; beyond three times that a number
    is said to be implausible.
    """
    told = []
    for index in candidate.indices:
        entry = space.entries[index]
        parameter = _parameter(entry)
        away = abs(theta[index] - (0.0 if parameter.whole else _neutral(entry)))
        if away > limits.implausible_times * parameter.typical[1]:
            place = "" if entry.component is None else f" {entry.component + 1}"
            told.append(
                f"{entry.effect} {entry.parameter}{place} = {theta[index]:.3g} {parameter.unit}"
            )
    return told


def at_bound(space: ParameterSpace, theta: np.ndarray, candidate: Candidate) -> bool:
    """Return whether a number of `candidate` has run to an end of what is physical.

    An end at which nothing acts is none: a drag that the vehicle file has may turn out not to be.
    """
    for index in candidate.indices:
        entry, value = space.entries[index], theta[index]
        close = 1e-6 * (entry.high - entry.low)
        sound = (entry.start, _neutral(entry))
        if value <= entry.low + close and entry.low not in sound:
            return True
        if value >= entry.high - close and entry.high not in sound:
            return True
    return False


def usual_first(
    space: ParameterSpace, theta: np.ndarray, candidate: Candidate
) -> tuple[bool, int, int]:
    """Return by what those of equal fit are ordered: what is plausible comes first.

    Then one effect comes before several, and then as the catalogue has them; `theta` (P,) is with
    this candidate.
    """
    effects = candidate.effects
    far = bool(implausible(space, theta, candidate))
    return far, len(effects), min(list(EFFECTS).index(name) for name in effects)


def _parameter(entry: FittedNumber) -> Parameter:
    return next(p for p in EFFECTS[entry.effect].parameters if p.name == entry.parameter)


def _neutral(entry: FittedNumber) -> float:
    """Return the value with which nothing acts; that of the file where it hangs on the vehicle."""
    neutral = _parameter(entry).neutral
    return entry.start if callable(neutral) else float(neutral)
