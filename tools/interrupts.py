"""Signals in the middle of cold compiles: how a training answers Ctrl-C and SIGTERM, and how soon.

    python tools/interrupts.py COUNT [SEED]

Every training starts without compiled code and is sent one of the two signals at a random moment of
its first 20 s. Prints a line each, and fails where one does not end with 130 within 5 s.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import tempfile
import time

TRAIN = "train --recipe quick --iterations 203 --set episode.batch=16 episode.steps=30"
WITHIN_S = 5.0
"""A signal is answered in this time."""


def interrupted(number: signal.Signals, after_s: float) -> tuple[int, float]:
    """Return the exit code of a training that gets a signal, and how long after [s]."""
    with tempfile.TemporaryDirectory() as folder:
        training = subprocess.Popen(
            [sys.executable, "-m", "suite.cli", *TRAIN.split(), "--out", folder],
            env={**os.environ, "JAX_ENABLE_COMPILATION_CACHE": "false"},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            # A shell has background jobs ignore Ctrl-C, and what ignores it ends by nothing else.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
        time.sleep(after_s)
        sent = time.monotonic()
        training.send_signal(number)
        return training.wait(), time.monotonic() - sent


def main() -> int:
    """Send as many signals as the command line asks for."""
    count, seed = int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0
    draw, bad = random.Random(seed), 0
    for _ in range(count):
        number, after_s = draw.choice([signal.SIGINT, signal.SIGTERM]), draw.uniform(1.5, 20.0)
        code, took_s = interrupted(number, after_s)
        bad += code != 130 or took_s > WITHIN_S
        print(f"{number.name} after {after_s:.1f} s: {code}, {took_s:.1f} s later", flush=True)
    print(f"{count - bad} of {count} ended with 130 within {WITHIN_S:g} s")
    return min(bad, 1)


if __name__ == "__main__":
    raise SystemExit(main())
