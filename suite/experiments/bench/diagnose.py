"""The benchmark `diagnose`: the fit of the diagnosis against `mujoco.sysid` on the same data.

Both fit six numbers (mass, centre of mass, inertia) to the same windows of five flights of 10 s,
from the same initial values, in turn. Only the fit is timed, after logs are read and programs are
compiled.
"""

from __future__ import annotations

from collections.abc import Mapping
from statistics import median
from typing import Any

import numpy as np

from suite.common.errors import WorkFailed
from suite.diagnose.data.noise import noise_of
from suite.diagnose.estimate.block import NormalEquations
from suite.diagnose.estimate.gauss_newton import fit, intervals95
from suite.diagnose.evidence.rollouts import RolloutModel, rollout_evidence, start_estimate
from suite.experiments.bench.compare import Comparison, compare_times, in_turn
from suite.experiments.bench.rigid_body import Task, make_task

SEED = 20_001
"""Seed of the truth, the flights and their noise; no blind case and no tuning used it."""
ROUNDS = 3
"""Number of timed fits of each side."""


def run(seed: int = SEED, duration_s: float = 10.0, rounds: int = ROUNDS) -> Comparison:
    """Time both refits in turn and compare their estimates.

    Args:
        seed: of the truth, the flights and their noise.
        duration_s: length of each of the five flights [s].
        rounds: number of timed fits of each side, after one call to warm up.

    Raises:
        WorkFailed: if a package of `mujoco.sysid` is missing.
    """
    from suite.experiments.bench import sysid_baseline

    if not sysid_baseline.is_installed():
        raise WorkFailed("mujoco.sysid lacks some of its packages: pip install 'mujoco[sysid]'")
    task = make_task(seed, duration_s)
    model = RolloutModel(
        task.nominal, task.space, rotor_input=True, voltage=False, integrator="euler"
    )
    begin = start_estimate(model, task.windows)
    residual = model.residual(begin.theta, begin.free, task.windows)
    problem = sysid_baseline.prepare(task, noise_of(residual, task.windows))
    answers: dict[str, tuple[np.ndarray, NormalEquations]] = {}

    def ours() -> None:
        answers["ours"] = refit(model, task)

    def theirs() -> None:
        answers["mujoco.sysid"] = sysid_baseline.refit(problem)

    times_s = in_turn({"ours": ours, "mujoco.sysid": theirs}, rounds)
    details = {
        **_agreement(task, answers),
        "stretches": len(task.windows.flight),
        "seed": seed,
        "seconds": {side: median(seconds) for side, seconds in times_s.items()},
    }
    return compare_times("diagnose", times_s, 60.0, "refits/min", details)


def refit(model: RolloutModel, task: Task) -> tuple[np.ndarray, NormalEquations]:
    """Return the fitted numbers (K,) and their normal equations, as the diagnosis fits them.

    It estimates the noise, linearises with respect to the numbers and the start of every window,
    and makes Gauss-Newton steps on the part of the windows in which the model is accurate. It
    repeats this while that part grows.
    """
    indices, state = list(task.indices), start_estimate(model, task.windows)
    used_values = 0
    while True:
        directions = [*indices, *model.starts]
        linear = model.linearise(state.theta, state.free, task.windows, directions)
        evidence, known = rollout_evidence(model, task.windows, linear, along=indices)
        state, block = fit(evidence, state, indices, known=known)
        if evidence.trusted.valid.sum() <= used_values:
            return state.theta[indices], block.equations
        used_values = evidence.trusted.valid.sum()


def _agreement(
    task: Task, answers: Mapping[str, tuple[np.ndarray, NormalEquations]]
) -> dict[str, Any]:
    """Return each side's numbers, and their difference over the joint 95 % half-width.

    The half-widths of both sides come from the disagreement between windows; the joint one is their
    root sum of squares.
    """
    widths = {side: intervals95(equations).half_width for side, (_, equations) in answers.items()}
    first, second = (values for values, _ in answers.values())
    difference = np.abs(first - second) / np.hypot(*widths.values())
    rows = {}
    for k, name in enumerate(task.names):
        rows[name] = {
            "truth": float(f"{task.truth[k]:.4g}"),
            **{
                side: f"{values[k]:.4g} +- {widths[side][k]:.2g}"
                for side, (values, _) in answers.items()
            },
            "apart_over_joint": round(float(difference[k]), 2),
        }
    return {**rows, "inside_the_joint_interval": f"{(difference <= 1.0).sum()} of {len(rows)}"}
