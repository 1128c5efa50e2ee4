"""Which flights are kept back to measure the gap on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from eval.logs.flight_log import FlightLog
from suite.diagnose.data.windows import Windows

SHARE = 0.2
"""Share of the flights that is kept back, at least one."""
ONE_FLIGHT = 0.7
"""Share of a lone flight that is fitted; the rest is held out."""


def split(
    logs: Sequence[FlightLog], windows: Windows, told: np.ndarray
) -> tuple[np.ndarray, list[str]]:
    """Return which windows are fitted, (W,) bool, and the names of what is held out.

    Held out are the flights that can best be spared: those of whose information on any number of
    the catalogue the others have most. What was measured has no say in it, only what was flown; a
    lone chirp or the only pass near the ground is fitted.

    Args:
        logs: flights.
        windows: W stretches of them.
        told: (W, K) information of each stretch on each of the catalogue's numbers.
    """
    flight = np.asarray(windows.flight)
    there = list(np.unique(flight))
    if len(there) == 1:
        log = logs[int(there[0])]
        cut_s = ONE_FLIGHT * log.duration_s
        return np.asarray(windows.start_s) + 1.0 <= cut_s, [f"{log.name} from {cut_s:.1f} s"]
    by_flight = {k: told[flight == k].sum(axis=0) for k in there}
    held: list[int] = []
    for _ in range(max(1, round(SHARE * len(there)))):
        kept = [k for k in there if k not in held]
        whole = np.sum([by_flight[k] for k in kept], axis=0)
        seen = whole > 0.0
        lost = {k: (by_flight[k][seen] / whole[seen]).max(initial=0.0) for k in kept}
        held.append(min(reversed(kept), key=lambda k: lost[k]))
    return ~np.isin(flight, held), [logs[int(k)].name for k in sorted(held)]
