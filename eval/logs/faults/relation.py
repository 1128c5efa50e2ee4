"""Compare two noisy measurements of one vector: their axes, signs and scale.

One measurement is the reference (`wanted`), such as the body rates from the attitude. The other is
the signal to check (`given`), such as the gyro, whose axes may be swapped or inverted.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import permutations
from typing import NamedTuple

import numpy as np

from eval.logs.faults.finding import Finding, unseen
from eval.logs.faults.reading import axes_matrix, option

ALIKE = 0.8
"""Two axes with a higher correlation measure the same."""
UNLIKE = 0.5
"""An axis is swapped or inverted if the best correlation exceeds the one as given by this."""
LEFT, TIMES_LEFT = 0.5, 20.0
"""An axis is also swapped or inverted if the unexplained share of its variance, as given, exceeds
the first value and is more than the second factor times the share with the best axis."""
CLEAR = 0.1
"""Another order of axes is chosen only if the sum of its squared correlations exceeds that of the
given order by this: on a straight line two axes are proportional, and noise alone would decide."""
AT_ONCE = 2**16
"""Number of values of a signal that are shifted at once."""
LEAST = 20
"""Least rows for a comparison."""
SEEN = 0.5
"""Least correlation at which an axis is identifiable."""

NEAR = 1.06
"""A scale within this factor of a unit's factor is explained by that unit."""
SAME = 1.1
"""A scale within this factor of 1 is correct."""
FAR = 1.15
"""A scale within this factor of 1 is no fault but a note: attitude filters cause as much."""
EXACT = 1.04
"""A scale within this factor of 1 needs no note."""
OK = 0.3
"""Largest relative residual of a correct signal."""


class Match(NamedTuple):
    """Relation between `wanted` (N, 3) and `given` (N, 3)."""

    axes: str
    """Columns and signs of `given` that equal x, y and z of `wanted`, such as `x,-y,-z`."""
    seen: np.ndarray
    """(3,) bool: identifiable axes of `wanted`."""
    alike: np.ndarray
    """(3,) correlation of each axis after `given` is read in the axes `axes`."""
    as_given: np.ndarray
    """(3,) correlation of each axis without a change."""
    scale: np.ndarray
    """(3,) ratio of `given` to `wanted`, in the axes `axes`."""
    low: np.ndarray
    """(3,) smallest scale that is consistent with noise in either measurement (Frisch 1934)."""
    high: np.ndarray
    """(3,) largest scale that is consistent with noise in either measurement."""
    level: np.ndarray
    """(3,) standard deviation of `wanted`."""
    rival: str
    """Alternative order of the axes that fits about as well, since two axes move in proportion; ""
    for none."""

    @property
    def is_turned(self) -> bool:
        """Whether the evidence for other axes than the given ones is overwhelming."""
        unexplained, unexplained_as_given = 1.0 - self.alike**2, 1.0 - self.as_given**2
        far = (unexplained_as_given > LEFT) & (unexplained_as_given > TIMES_LEFT * unexplained)
        worse = self.seen & ((self.alike - self.as_given > UNLIKE) | far)
        changed = np.array([axis != "xyz"[k] for k, axis in enumerate(self.axes.split(","))])
        return bool((worse & changed).any() and (self.alike[changed & self.seen] > ALIKE).all())

    @property
    def is_mirrored(self) -> bool:
        """Whether an axis has the wrong sign, while other axes are too small to confirm it."""
        worse = self.seen & (self.alike - self.as_given > UNLIKE) & (self.alike > ALIKE)
        return bool(worse.any() and "".join(self.axes.split(",")).replace("-", "") == "xyz")

    def misfit(self, correlations: np.ndarray) -> float:
        """Return the relative residual at these correlations (3,), after the scale is fitted."""
        weight = self.level**2
        unexplained = weight * (1.0 - np.clip(correlations, 0.0, 1.0) ** 2)
        return float(np.sqrt(unexplained.sum() / max(weight.sum(), 1e-12)))


def match(wanted: np.ndarray, given: np.ndarray) -> Match:
    """Return the relation of `given` (N, 3) to `wanted` (N, 3).

    Rows with a NaN or an outlier are not used.
    """
    good = np.isfinite(wanted).all(axis=1) & np.isfinite(given).all(axis=1)
    for size in (np.linalg.norm(value, axis=1) for value in (wanted, given)):
        if good.any():
            good = good & (size <= 8.0 * np.quantile(size[good], 0.9) + 1e-12)
    wanted, given = wanted[good], given[good]
    if len(wanted) < LEAST:
        wanted = given = np.zeros((LEAST, 3))
    # Correlation of every axis with every other, and the order of axes with the largest ones.
    level, other = wanted.std(axis=0), given.std(axis=0)
    wanted, given = wanted - wanted.mean(axis=0), given - given.mean(axis=0)
    norms = np.outer(np.maximum(level, 1e-12), np.maximum(other, 1e-12)) * max(len(wanted), 1)
    corr = (wanted.T @ given) / norms
    score = {p: float(np.sum(corr[range(3), p] ** 2)) for p in permutations(range(3))}
    order = max(score, key=lambda p: score[p] + CLEAR * (p == (0, 1, 2)))
    best = corr[range(3), order]
    seen = np.abs(best) > SEEN
    if not seen[[k for k in range(3) if order[k] != k]].all():
        order, best = (0, 1, 2), np.diag(corr).copy()
        seen = np.abs(best) > SEEN
    sign = np.where(seen & (best < 0.0), -1.0, 1.0)
    names = [("-" if s < 0 else "") + "xyz"[k] for k, s in zip(order, sign, strict=True)]
    # Alternative orders, whose changed axes correlate well with both.
    alternatives = [
        p
        for p in score
        if p != order
        and score[p] > score[order] - CLEAR
        and all(abs(corr[k, p[k]]) > ALIKE for k in range(3) if p[k] != order[k])
    ]
    rival = ",".join("xyz"[k] for k in max(alternatives, key=lambda p: score[p], default=()))
    ratio = other[list(order)] / np.maximum(level, 1e-12)
    r = np.clip(np.abs(best), 1e-3, 1.0)
    alike = best * sign
    as_given = np.diag(corr)
    return Match(",".join(names), seen, alike, as_given, ratio, ratio * r, ratio / r, level, rival)


def pooled_scale(found: Match) -> tuple[float, float, float]:
    """Return the common scale of the identifiable axes, and its least and largest value.

    All three are weighted geometric means over the axes; NaN where no axis is identifiable.
    """
    weight = (found.level**2 * found.alike**4)[found.seen]  # the scale of an unseen axis may be 0
    if weight.sum() == 0.0:
        return np.nan, np.nan, np.nan
    mean = [
        float(np.exp(np.sum(weight * np.log(value[found.seen])) / weight.sum()))
        for value in (found.scale, found.low, found.high)
    ]
    return mean[0], mean[1], mean[2]


def within(table: Mapping[str, float], limit: float, factor: float) -> list[str]:
    """Return the names in `table` whose value is within the ratio `limit` of `factor`."""
    return [n for n, wrong in table.items() if abs(np.log(factor / wrong)) < np.log(limit)]


def axes_finding(found: Match, signal: str, subject: str) -> Finding:
    """Return the finding for a signal whose axes are swapped or inverted."""
    alike = ", ".join(
        f"{axis} {value:+.2f}" for axis, value in zip("xyz", found.as_given, strict=True)
    )
    frame = {"x,-y,-z": "body_frame"}.get(found.axes, f"{subject}_axes")
    text = f"correlations with what it should be are {alike}; its axes are {found.axes}"
    if frame == "gyro_axes" and np.linalg.det(axes_matrix(found.axes)) > 0.0:
        text += ", or the attitude's body is rotated by as much against the vehicle"
    sure = float(np.clip(np.min(found.alike[found.seen]), 0.0, 0.99))
    fix = option((signal, found.axes))
    status = "corrected" if found.is_turned else "doubt"
    return Finding(status, subject, text, frame, None, max(sure, 0.9), fix)


def unseen_axes(found: Match, subject: str, *faults: str) -> list[Finding]:
    """Return findings for axes that cannot be checked: with too little motion, or in proportion."""
    axes = " and ".join(axis for axis, seen in zip("xyz", found.seen, strict=True) if not seen)
    text = f"along {axes} there is too little to check its sign by"
    findings = unseen(subject, text, *faults) if axes else []
    text = f"two axes move in proportion, so that the order {found.rival} fits about as well"
    return findings + (unseen(subject, text, faults[0]) if found.rival else [])


def scale_findings(
    found: Match,
    units: Mapping[str, float],
    signal: str,
    subject: str,
    fault: str,
    of: str,
    same: float = SAME,
) -> list[Finding]:
    """Return the findings on a signal's scale: correct, a wrong unit, or an unknown factor.

    `of` names the reference in words; a scale within the factor `same` of 1 is correct. Where the
    signal resembles the reference little, a scale that is no unit's has no fix.
    """
    scale, low, high = pooled_scale(found)
    figures = f"it is {scale:.3g} times {of} ({low:.3g} to {high:.3g})"
    if not np.isfinite(scale) or low < 1.0 < high or 1.0 / EXACT < scale < EXACT:
        return [Finding("ok", subject, figures)]
    if 1.0 / same < scale < same:
        return [Finding("note", subject, f"{figures}: a filter, a scale, or the rate of a clock")]
    if low / max(FAR, same) < 1.0 < high * max(FAR, same):
        text = f"{figures}: filters of the log may cause as much"
        return [Finding("note", subject, text), *unseen(subject, text, fault)]
    distance = {words: abs(np.log(scale / factor)) for words, factor in units.items()}
    words, *others = sorted(distance, key=lambda name: distance[name])
    if low / NEAR < units[words] < high * NEAR and distance[words] < np.log(1.3):
        clear = distance[words] < 0.5 * min((distance[name] for name in others), default=np.inf)
        fix = option((signal, f"{1.0 / units[words]:.10g}"))
        status, sure = ("corrected", 0.99) if clear else ("doubt", 0.9)
        return [Finding(status, subject, f"{figures}: {words}", fault, scale, sure, fix)]
    misfit = found.misfit(found.alike)
    if misfit > OK:
        text = f"{figures}, and off them by {100 * misfit:.0f} % then: a filter or a limited range"
        return [Finding("doubt", subject, text, fault, scale, 0.6)]
    sure = 0.97 if high / low < 1.15 else 0.9 if high / low < 1.5 else 0.6
    fix = option((signal, f"{1.0 / scale:.4g}"))
    text = f"{figures}, which is no unit's doing; check its range and scale, and the clock"
    return [Finding("doubt", subject, text, fault, scale, sure, fix)]


def smooth(time_s: np.ndarray, value: np.ndarray, width_s: float) -> np.ndarray:
    """Return the moving mean (T, C) of `value` over `width_s`; NaN where many are missing."""
    first = np.searchsorted(time_s, time_s - 0.5 * width_s)
    stop = np.searchsorted(time_s, time_s + 0.5 * width_s, side="right")
    known = np.asarray(np.isfinite(value).all(axis=1))
    sums = np.concatenate(
        [np.zeros((1, value.shape[1])), np.cumsum(np.where(known[:, None], value, 0.0), 0)]
    )
    count = np.concatenate([[0], np.cumsum(known)])
    inside = (count[stop] - count[first])[:, None]
    enough = np.asarray(inside > 0.6 * (stop - first)[:, None])
    return np.where(enough, (sums[stop] - sums[first]) / np.maximum(inside, 1), np.nan)


def interpolate(time_s: np.ndarray, known_s: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return `value` (N, C), known at the increasing times `known_s` (N,), at `time_s` (T, C).

    It is linear between two samples, and constant before the first and after the last.
    """
    return np.stack([np.interp(time_s, known_s, column) for column in value.T], axis=1)


def shifted(
    time_s: np.ndarray, trials_s: np.ndarray, known_s: np.ndarray, value: np.ndarray
) -> Iterator[tuple[slice, np.ndarray]]:
    """Yield `value` (N, C), known at `known_s` (N,), at `time_s` (T,) plus each of `trials_s`.

    Each item has the trials (a slice of K) and their values (C, K, T), interpolated linearly. A
    long log has few trials in an item, so that all arrays stay small.
    """
    count = max(1, AT_ONCE // len(time_s))
    for first in range(0, len(trials_s), count):
        some = slice(first, first + count)
        at_s = trials_s[some, None] + time_s
        yield some, np.stack([np.interp(at_s, known_s, column) for column in value.T])


def forward_mean(value: np.ndarray, count: int) -> np.ndarray:
    """Return the mean (T - count + 1, C) of `count` rows of `value` (T, C) from each row on.

    It is NaN where one of these rows is missing.
    """
    known = np.isfinite(value)
    sums, knowns = (
        np.concatenate([np.zeros((1, value.shape[1])), np.cumsum(part, axis=0)])
        for part in (np.where(known, value, 0.0), known)
    )
    complete = knowns[count:] - knowns[:-count] == count
    return np.where(complete, (sums[count:] - sums[:-count]) / count, np.nan)


def shift_rows(values: np.ndarray, count: int) -> np.ndarray:
    """Return `values` (T, C) moved to `count` rows later; NaN before the first.

    `count` may exceed T, as in a log with bursts of rows, whose median step is short.
    """
    moved = np.full_like(values, np.nan)
    moved[count:] = values[: max(0, len(values) - count)]
    return moved


def rms(value: np.ndarray) -> float:
    """Return the root mean square of the smallest 95 % of rows, so that glitches do not count."""
    squared = np.sum(np.atleast_2d(value.T).T ** 2, axis=1)
    squared = squared[np.isfinite(squared)]
    return float(rms_of_squares(squared)) if len(squared) else 0.0


def rms_of_squares(squared: np.ndarray) -> np.ndarray:
    """Return `rms` (...) of rows whose squared sizes (..., N) are given and finite."""
    kept = max(1, int(0.95 * squared.shape[-1]))
    return np.sqrt(np.sort(squared, axis=-1)[..., :kept].mean(axis=-1))


def jackknife_error(left_out: np.ndarray) -> float:
    """Return the jackknife's standard error from estimates (B,), each without one of B blocks."""
    count = len(left_out)
    return float(np.sqrt((count - 1) / count * np.sum((left_out - left_out.mean()) ** 2)))
