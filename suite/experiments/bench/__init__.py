"""Benchmarks: our hot paths against plain implementations of the same, in turn in one run."""

from __future__ import annotations

BENCHES: dict[str, str] = {
    "train": "gradient steps a second against a plain torch-eager loop of the same method",
    "policy": "a step of the shipped policy exported as C against ONNX Runtime, on one thread",
    "judge": "trials a second of processor time against the same with MuJoCo's own rays",
    "env": "decisions a second of 64 races in one vector environment against 64 in a loop",
    "diagnose": "refits a minute of six numbers against mujoco.sysid on the same flights",
}
"""Name -> one-line summary; NAME.py has `run() -> Comparison`."""
