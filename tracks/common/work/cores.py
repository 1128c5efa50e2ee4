"""The processor cores that this process may run on, and how processes share them."""

from __future__ import annotations

import os


def usable_cores() -> int:
    """Return how many processor cores this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def core_shares(workers: int) -> list[list[int]]:
    """Return the cores of each of `workers` processes; empty lists where a system cannot pin."""
    if not hasattr(os, "sched_getaffinity"):
        return [[] for _ in range(workers)]
    cores = sorted(os.sched_getaffinity(0))
    each = len(cores) // workers
    return [cores[k * each : (k + 1) * each] for k in range(workers)]
