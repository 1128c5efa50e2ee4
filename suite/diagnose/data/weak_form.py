"""Accelerations without derivatives: velocities and models weighed by the same smooth bumps.

Over a bump w(t) that is zero at both ends, the mean of an acceleration is -integral(w' v) over
integral(w): what was measured is never differentiated, and the model's acceleration is smoothed in
just the same way (modulating functions; Shinbrot 1957, Trans. ASME 79).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import sparse

from eval.importers.rows import nearest


class WeakForm(NamedTuple):
    """M bumps over the N rows of a flight."""

    middle_s: np.ndarray
    """(M,) since the first row [s]."""
    middle_row: np.ndarray
    """(M,) row nearest to it."""
    change: sparse.csr_array
    """(M, N) takes velocities to mean accelerations."""
    mean: sparse.csr_array
    """(M, N) takes accelerations to their means."""


def weak_form(time_s: np.ndarray, good: np.ndarray, width_s: float, hole_s: float) -> WeakForm:
    """Return bumps of `width_s`, half of it apart, that reach across no bad row and no hole.

    Args:
        time_s: (N,) increasing [s].
        good: (N,) bool: rows that can be used.
        width_s: from a bump's begin to its end [s].
        hole_s: rows further apart are a hole [s].
    """
    span = np.diff(time_s)
    middle = 0.5 * (time_s[1:] + time_s[:-1])
    usable = good[1:] & good[:-1] & (span <= hole_s)
    centres = np.arange(time_s[0] + 0.5 * width_s, time_s[-1] - 0.5 * width_s, 0.5 * width_s)
    kept, rows, columns, shares, spans = [], [], [], [], []
    for centre in centres:
        first, last = np.searchsorted(middle, (centre - 0.5 * width_s, centre + 0.5 * width_s))
        if last - first < LEAST_ROWS or not usable[first:last].all():
            continue
        share = np.cos(np.pi * (middle[first:last] - centre) / width_s) ** 2
        share /= (share * span[first:last]).sum()
        rows.append(np.full(last - first, len(kept)))
        columns.append(np.arange(first, last))
        shares.append(share)
        spans.append(share * span[first:last])
        kept.append(centre)
    shape = (len(kept), len(time_s))
    if not kept:
        none = sparse.csr_array(shape)
        return WeakForm(np.zeros(0), np.zeros(0, int), none, none)
    row, column = np.concatenate(rows), np.concatenate(columns)

    def matrix(before: np.ndarray, after: np.ndarray) -> sparse.csr_array:
        places = (np.concatenate([row, row]), np.concatenate([column, column + 1]))
        return sparse.csr_array((np.concatenate([before, after]), places), shape=shape)

    share, weight = np.concatenate(shares), 0.5 * np.concatenate(spans)
    centres = np.array(kept)
    middle_row = nearest(time_s, centres)
    return WeakForm(centres, middle_row, matrix(-share, share), matrix(weight, weight))


LEAST_ROWS = 4
"""Steps between rows in a bump, at least."""
