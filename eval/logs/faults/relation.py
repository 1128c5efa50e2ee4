"""Compare two noisy measurements of one vector: their axes, signs and scale."""

from __future__ import annotations

from itertools import permutations
from typing import NamedTuple

import numpy as np

ALIKE = 0.8
"""Axes with a higher correlation are the same."""
UNLIKE = 0.5
"""An axis is another one if the best correlation exceeds that with its own axis by this."""
LEFT, TIMES_LEFT = 0.5, 20.0
"""So it is if its own axis leaves more than the first share of its variance unexplained, and more
than the second factor times what the best axis leaves."""
CLEAR = 0.1
"""Another order of axes is taken where its squared correlations exceed those of the given order by
this in all: on a straight line two axes are proportional, and noise alone would decide."""
LEAST = 20
"""Least rows for a comparison."""
SEEN = 0.5
"""Least correlation at which an axis is identifiable."""


class Match(NamedTuple):
    """Relation between `wanted` (N, 3) and `given` (N, 3)."""

    axes: str
    """Columns and signs of `given` that equal x, y and z of `wanted`, such as `x,-y,-z`."""
    seen: np.ndarray
    """(3,) bool: identifiable axes of `wanted`."""
    alike: np.ndarray
    """(3,) correlation in the axes `axes`."""
    as_given: np.ndarray
    """(3,) correlation in the given axes."""
    scale: np.ndarray
    """(3,) given divided by wanted, in the axes `axes`."""
    low: np.ndarray
    """(3,) smallest and ..."""
    high: np.ndarray
    """... largest scale consistent with noise in either of them (Frisch 1934)."""
    level: np.ndarray
    """(3,) standard deviation of `wanted`."""
    rival: str
    """Other axes that fit about as well, since two of them move in proportion; "" for none."""

    @property
    def is_turned(self) -> bool:
        """Whether the evidence for other axes than the given ones is overwhelming."""
        left, left_as_given = 1.0 - self.alike**2, 1.0 - self.as_given**2
        far = (left_as_given > LEFT) & (left_as_given > TIMES_LEFT * left)
        worse = self.seen & ((self.alike - self.as_given > UNLIKE) | far)
        changed = np.array([axis != "xyz"[k] for k, axis in enumerate(self.axes.split(","))])
        return bool((worse & changed).any() and (self.alike[changed & self.seen] > ALIKE).all())

    @property
    def is_mirrored(self) -> bool:
        """Whether an axis has the wrong sign, while other axes are too small to confirm it."""
        worse = self.seen & (self.alike - self.as_given > UNLIKE) & (self.alike > ALIKE)
        return bool(worse.any() and "".join(self.axes.split(",")).replace("-", "") == "xyz")

    @property
    def fits(self) -> bool:
        """Whether all identifiable axes fit as given."""
        return bool(self.seen.any() and (self.as_given[self.seen] > SEEN).all())


def match(wanted: np.ndarray, given: np.ndarray) -> Match:
    """Return the relation of `given` (N, 3) to `wanted` (N, 3); rows with a NaN are not used."""
    wanted, given = _clear(wanted, given)
    if len(wanted) < LEAST:
        wanted = given = np.zeros((LEAST, 3))
    level, other = wanted.std(axis=0), given.std(axis=0)
    wanted, given = wanted - wanted.mean(axis=0), given - given.mean(axis=0)
    size = np.outer(np.maximum(level, 1e-12), np.maximum(other, 1e-12)) * max(len(wanted), 1)
    corr = (wanted.T @ given) / size
    score = {p: float(np.sum(corr[range(3), p] ** 2)) for p in permutations(range(3))}
    order = max(score, key=lambda p: score[p] + CLEAR * (p == (0, 1, 2)))
    best = corr[range(3), order]
    seen = np.abs(best) > SEEN
    if not seen[[k for k in range(3) if order[k] != k]].all():
        order, best = (0, 1, 2), np.diag(corr).copy()
        seen = np.abs(best) > SEEN
    sign = np.where(seen & (best < 0.0), -1.0, 1.0)
    names = [("-" if s < 0 else "") + "xyz"[k] for k, s in zip(order, sign, strict=True)]
    rivals = [
        p
        for p in score
        if p != order
        and score[p] > score[order] - CLEAR
        and all(abs(corr[k, p[k]]) > ALIKE for k in range(3) if p[k] != order[k])
    ]
    rival = ",".join("xyz"[k] for k in max(rivals, key=lambda p: score[p])) if rivals else ""
    ratio = other[list(order)] / np.maximum(level, 1e-12)
    r = np.clip(np.abs(best), 1e-3, 1.0)
    alike = best * sign
    as_given = np.diag(corr)
    return Match(",".join(names), seen, alike, as_given, ratio, ratio * r, ratio / r, level, rival)


def pooled_scale(found: Match) -> tuple[float, float, float]:
    """Return the common scale of the identifiable axes, and its least and largest value."""
    weight = np.where(found.seen, found.level**2 * found.alike**4, 0.0)
    if weight.sum() == 0.0:
        return np.nan, np.nan, np.nan
    mean = [
        float(np.exp(np.sum(weight * np.log(value)) / weight.sum()))
        for value in (found.scale, found.low, found.high)
    ]
    return mean[0], mean[1], mean[2]


def smooth(time_s: np.ndarray, value: np.ndarray, width_s: float) -> np.ndarray:
    """Return the mean (T, C) of `value` over `width_s` around each time; NaN in gaps."""
    first = np.searchsorted(time_s, time_s - 0.5 * width_s)
    stop = np.searchsorted(time_s, time_s + 0.5 * width_s, side="right")
    known = np.asarray(np.isfinite(value).all(axis=1))
    full = np.concatenate(
        [np.zeros((1, value.shape[1])), np.cumsum(np.where(known[:, None], value, 0.0), 0)]
    )
    count = np.concatenate([[0], np.cumsum(known)])
    inside = (count[stop] - count[first])[:, None]
    enough = np.asarray(inside > 0.6 * (stop - first)[:, None])
    return np.where(enough, (full[stop] - full[first]) / np.maximum(inside, 1), np.nan)


def rms(value: np.ndarray) -> float:
    """Return the root mean square of the smallest 95 %, so that glitches have no influence."""
    squared = np.sum(np.atleast_2d(value.T).T ** 2, axis=1)
    squared = np.sort(squared[np.isfinite(squared)])
    squared = squared[: max(1, int(0.95 * len(squared)))]
    return float(np.sqrt(np.mean(squared))) if len(squared) else 0.0


def jackknife_error(left_out: np.ndarray) -> float:
    """Return the standard error from estimates (B,) that leave out one block each."""
    count = len(left_out)
    return float(np.sqrt((count - 1) / count * np.sum((left_out - left_out.mean()) ** 2)))


def _clear(wanted: np.ndarray, given: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows in which both are finite and neither is an outlier."""
    good = np.isfinite(wanted).all(axis=1) & np.isfinite(given).all(axis=1)
    for value in (wanted, given):
        size = np.linalg.norm(value, axis=1)
        known = size[good]
        if len(known):
            good = good & (size <= 8.0 * np.quantile(known, 0.9) + 1e-12)
    return wanted[good], given[good]
