"""What is left of a training's speed while another program keeps a core busy.

    python tools/beside.py [ROUNDS] [RECIPE]

Iterations of a recipe alone and beside a loop that does nothing, pinned to the last core, in turn.
Prints for every block the steps of worlds a second, the cores that the training got, and the steps
of each second of a core: where this stays the same, the training lost what others took and no more.
The column "others" says how much of the machine a third party had; such blocks are worth little.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from suite.common.startup import keep_compiled
from tracks.common.work import usable_cores
from tracks.common.work.threads import set_threads

BUSY = [sys.executable, "-c", "while True: pass"]
ITERATIONS = 6
"""Of a block."""
TICK_S = 1 / os.sysconf("SC_CLK_TCK")


def used_s(pid: int | None = None) -> float:
    """Return the processor time [s] of a process, or of all with the system's."""
    if pid is None:
        user, nice, system = Path("/proc/stat").read_text().split()[1:4]
        return (int(user) + int(nice) + int(system)) * TICK_S
    user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) * TICK_S


def trainer(name: str) -> tuple[Callable[[], None], int]:
    """Return a function that does one iteration of a recipe, and the steps of worlds in it."""
    import jax

    from suite.train.recipes import named_recipe
    from suite.train.update import make_update, start_state
    from suite.train.worlds import sample_worlds

    config = named_recipe(name)
    update, number, first = make_update(config), 0, jax.devices()[0]
    state, worlds = jax.device_put(start_state(config), first), sample_worlds(config, 0)

    def iterate() -> None:
        nonlocal state, worlds, number
        state, numbers = update(state, worlds)
        number += 1
        worlds = sample_worlds(config, number)
        float(numbers["loss"])

    return iterate, config.episode.batch * config.episode.steps


def main() -> int:
    """Measure as the command line asks."""
    keep_compiled()
    set_threads()
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 3
    iterate, steps = trainer(sys.argv[2] if len(sys.argv) > 2 else "quick")
    iterate()
    iterate()
    print("beside   steps/s   cores   steps a core second   others")
    for _ in range(rounds):
        for beside in (False, True):
            busy = subprocess.Popen(BUSY) if beside else None
            if busy:
                os.sched_setaffinity(busy.pid, [max(os.sched_getaffinity(0))])
            before = (
                time.monotonic(),
                time.process_time(),
                used_s(),
                used_s(busy.pid) if busy else 0,
            )
            for _ in range(ITERATIONS):
                iterate()
            after = time.monotonic(), time.process_time(), used_s(), used_s(busy.pid) if busy else 0
            took_s, own_s, all_s, busy_s = (b - a for a, b in zip(before, after, strict=True))
            if busy:
                busy.kill()
                busy.wait()
            speed, cores = ITERATIONS * steps / took_s, own_s / took_s
            others = (all_s - own_s - busy_s) / took_s
            said = f"{speed:8.0f} {cores:7.2f} {speed / cores:21.0f} {others:8.2f}"
            print(f"{'a loop' if beside else 'nothing':7s} {said}", flush=True)
    print(f"of {usable_cores()} cores")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
