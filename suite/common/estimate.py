"""Say before a long command starts how long it will take and how much memory it needs."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from suite.common.console import Console, duration, size


@dataclass(frozen=True)
class Estimate:
    """What a piece of work will need; a guess within a factor of about two."""

    seconds: float
    """Time [s]."""
    memory_bytes: float
    """Memory at its peak [bytes]."""


def available_memory_bytes() -> int:
    """Return how much memory can be had without swapping [bytes]; all of it where unknown."""
    try:
        text = Path("/proc/meminfo").read_text(encoding="ascii")
        return 1024 * int(text.split("MemAvailable:")[1].split()[0])
    except (OSError, IndexError):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def announce(console: Console, what: str, estimate: Estimate) -> None:
    """Say `estimate` of `what`, and warn where the memory is not there."""
    free = available_memory_bytes()
    need = size(estimate.memory_bytes)
    console.note(f"{what}: about {duration(estimate.seconds)} and {need} of memory")
    if estimate.memory_bytes > free:
        console.note(f"warning: only {size(free)} of memory is free; expect it to fail or to swap")
