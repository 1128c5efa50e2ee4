"""Which flights are held out to measure the gap on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from eval.logs.flight_log import FlightLog
from suite.diagnose.data.windows import LENGTH_S
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


def choose_held_out(
    logs: Sequence[FlightLog],
    flight: np.ndarray,
    start_s: np.ndarray,
    information: np.ndarray,
    limits: Thresholds = THRESHOLDS,
) -> tuple[np.ndarray, list[str]]:
    """Return which windows are fitted, (W,) bool, and the names of what is held out.

    `flight` (W,) is the number of each window's flight, `start_s` (W,) when it starts there.

    Held out are the flights that can best be spared: those of whose `information` (W, K), of each
    window on each number of the catalogue, the others have most. What was measured has no say in
    it, only what was flown; a lone chirp or the only pass near the ground is fitted.
    """
    flight = np.asarray(flight)
    there = list(np.unique(flight))
    if len(there) == 1:
        log = logs[int(there[0])]
        cut_s = limits.lone_fitted_share * log.duration_s
        return np.asarray(start_s) + LENGTH_S <= cut_s, [f"{log.name} from {cut_s:.1f} s"]
    by_flight = {k: information[flight == k].sum(axis=0) for k in there}
    held: list[int] = []
    for _ in range(max(1, round(limits.held_out_share * len(there)))):
        kept = [k for k in there if k not in held]
        whole = np.sum([by_flight[k] for k in kept], axis=0)
        seen = whole > 0.0
        lost = {k: (by_flight[k][seen] / whole[seen]).max(initial=0.0) for k in kept}
        held.append(min(reversed(kept), key=lambda k: lost[k]))
    return ~np.isin(flight, held), [logs[int(k)].name for k in sorted(held)]
