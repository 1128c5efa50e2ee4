"""Check of a position for jumps, which two flights in one file or a lost tracker leave."""

from __future__ import annotations

import numpy as np

from eval.logs.faults.finding import Finding

ACC_MAX = 60.0
"""Largest possible acceleration [m/s^2]."""
LEAST_M, SURE_SD = 0.1, 10.0
"""Least size of a jump: in metres, and in standard deviations of the usual steps."""
STEPS = 5
"""Number of steps before and after, of which the median is the velocity."""
FAULT_M = 0.5
"""A jump below this size is a note [m]: the estimators of real vehicles correct themselves so."""


def check_jumps(time_s: np.ndarray, pos: np.ndarray) -> list[Finding]:
    """Return the finding on the largest jump of a position, [] for none.

    A jump is a step between two samples that neither the velocity before nor the one after it
    explains; after a collision, the latter does. Rows that are missing only make a step longer.

    Args:
        time_s: (N,) increasing times [s].
        pos: (N, 3) positions, NaN where unknown.
    """
    # Of a position that is held between its samples, the first row of each counts.
    known = np.flatnonzero(np.isfinite(pos).all(axis=1))
    is_new = (np.diff(pos[known], axis=0) != 0.0).any(axis=1) & (np.diff(time_s[known]) > 0.0)
    known = known[np.append(True, is_new)] if len(known) else known
    time_s, pos = time_s[known], pos[known]
    if len(time_s) < 4 * STEPS:
        return []
    step_s = np.diff(time_s)
    velocity = np.diff(pos, axis=0) / step_s[:, None]
    windows = np.lib.stride_tricks.sliding_window_view(velocity, STEPS, axis=0)
    usual = np.median(windows, axis=-1)
    k = np.arange(STEPS, len(step_s) - STEPS)
    size_m = step_s[k] * np.min(
        [np.linalg.norm(velocity[k] - usual[k + other], axis=1) for other in (-STEPS, 1)], axis=0
    )
    # The median velocity is that of the middle of its window: half of its steps away.
    around_s = np.lib.stride_tricks.sliding_window_view(step_s, 2 * STEPS + 1).mean(axis=-1)
    turned_m = ACC_MAX * 0.5 * (STEPS + 1) * around_s * step_s[k]
    noise_m = SURE_SD / 0.6745 * float(np.median(size_m))
    excess_m = size_m - (LEAST_M + turned_m + 0.5 * ACC_MAX * step_s[k] ** 2 + noise_m)
    jumps = np.flatnonzero(excess_m > 0.0)
    if not len(jumps):
        return []
    worst = jumps[np.argmax(size_m[jumps])]
    first = int(k[worst])
    others = f" ({len(jumps)} such steps)" if len(jumps) > 1 else ""
    at_s, jump_m = float(time_s[first]), float(size_m[worst])
    text = f"it jumps by {jump_m:.2g} m between two rows at t = {at_s:.2f} s{others}: a glitch"
    if jump_m < FAULT_M:
        return [Finding("note", "position", text)]
    text += ", or two flights in one file"
    fix = "cut the log there with --start or --end of suite import"
    return [Finding("doubt", "position", text, "position_jump", jump_m, 0.95, fix)]
