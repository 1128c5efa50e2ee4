"""The benchmark `policy`: a step of the C export against one of ONNX Runtime, each on one thread.

The shipped policy is exported as C (float32 and int8), compiled for this machine and stepped one
observation at a time with its memory, in turn with ONNX Runtime and torch, each called from Python.
The baseline is ONNX Runtime as it is usually called, `session.run`. It is also timed with inputs
and outputs bound to memory beforehand.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from suite.common.errors import WorkFailed
from suite.experiments.bench.compare import Comparison, Figure
from tracks.common.grid import Grid, table


def run(policy: str = "") -> Comparison:
    """Time blocks of 100 steps of every engine (C export, ONNX Runtime, torch) in turn.

    Raises:
        WorkFailed: without a C compiler.
    """
    import torch

    from policies.formats.c.arrays import multiply_adds
    from policies.formats.c.compiler import find_compiler
    from policies.formats.c.source import constant_bytes, memory_bytes
    from policies.formats.export import exported_checkpoint
    from suite.judging.deploy.latency import onnx_steps, time_in_turn, torch_step
    from suite.judging.flying import default_policy

    if find_compiler() is None:
        raise WorkFailed("no C compiler (cc, or what CC names); install one, such as gcc")
    name, checkpoint = exported_checkpoint(policy or default_policy())
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with tempfile.TemporaryDirectory() as folder:
            steps, layers = _c_steps(name, checkpoint, Path(folder))
            run_step, bound_step = onnx_steps(checkpoint)
            steps |= {"ONNX Runtime": run_step, "ONNX Runtime, memory bound": bound_step}
            steps["torch"] = torch_step(checkpoint)
            times = time_in_turn(steps)
    finally:
        torch.set_num_threads(threads)
    multiply_add_count = multiply_adds(checkpoint.spec)
    weight_bytes = sum(x.nbytes for x in checkpoint.params.values())
    rows: dict[str, dict[str, Any]] = {}
    for engine, timing in times.items():
        row: dict[str, Any] = {
            "median_us": 1e6 * timing.median_s,
            "p99_us": 1e6 * timing.p99_s,
            "max_us": 1e6 * timing.max_s,
            "multiply_adds": multiply_add_count,
            "weight_bytes": weight_bytes,
            "working_bytes": None,
        }
        if engine in layers:
            quantised = layers[engine]
            row["weight_bytes"] = constant_bytes(checkpoint, quantised)
            row["working_bytes"] = memory_bytes(checkpoint.spec, quantised is not None)
        rows[engine] = row
    ours, baseline = (
        Figure(rows[engine]["median_us"], "us/step, median", less_is_better=True)
        for engine in ("C float32", "ONNX Runtime")
    )
    return Comparison("policy", ours, baseline, details={"policy": name, **rows}, grid=_grid(rows))


def _c_steps(name: str, checkpoint: Any, folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return a function that makes one step, and the quantised layers, of each C export by engine.

    The layers of the float32 export are None.
    """
    from policies.formats.c.c_file import load_c
    from policies.formats.c.project import c_project, random_observations
    from suite.judging.deploy.latency import c_step

    # The time of a step does not depend on the scales, so no flights are needed for them.
    observed, steps, layers = random_observations(checkpoint.spec, 50), {}, {}
    for dtype in ("float32", "int8"):
        engine, out = f"C {dtype}", folder / dtype
        project = c_project(checkpoint, name, dtype, observed)
        out.mkdir()
        for file, text in project.files.items():
            (out / file).write_text(text, encoding="utf-8")
        steps[engine], layers[engine] = c_step(load_c(out, trust=True)), project.layers
    return steps, layers


def _grid(rows: dict[str, dict[str, Any]]) -> Grid:
    """Return a table of the measured times and sizes, a row per engine."""
    columns = {
        "median [us]": ("median_us", ".1f"),
        "p99 [us]": ("p99_us", ".1f"),
        "longest [us]": ("max_us", ".1f"),
        "multiply-adds": ("multiply_adds", "d"),
        "weights [B]": ("weight_bytes", "d"),
        "working memory [B]": ("working_bytes", "d"),
    }
    lines = [
        [name] + [format(row[k], f) if row.get(k) is not None else "-" for k, f in columns.values()]
        for name, row in rows.items()
    ]
    return table(["engine", *columns], lines)
