"""Benchmarks: the speed of core parts of the suite against plain implementations.

Both sides of a benchmark run in turn in one process, so that they have the same machine.
"""

from __future__ import annotations

BENCHES: dict[str, str] = {
    "train": "trained decisions per second against a plain torch-eager loop of the same method",
    "policy": "a step of the shipped policy exported as C against ONNX Runtime, on one thread",
    "judge": "trials per second of processor time against MuJoCo's own depth rays",
    "env": "decisions per second of 64 races in one vector environment against 64 in a loop",
    "diagnose": "refits per minute of six numbers against mujoco.sysid on the same flights",
}
"""Name -> one-line summary; the module NAME.py has `run() -> Comparison`."""
