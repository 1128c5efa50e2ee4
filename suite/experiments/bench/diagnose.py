"""The benchmark `diagnose`: the fit of the diagnosis against `mujoco.sysid` on the same data.

Both fit six parameters (of mass, centre of mass and inertia) to the same windows (short parts) of
five flights of 10 s, from the same initial values. They run in turn. Only the fit is timed, not the
reading of logs and the compiling of programs before it.
"""

from __future__ import annotations

from collections.abc import Mapping
from statistics import median
from typing import Any

import numpy as np

from suite.common.errors import WorkFailed
from suite.diagnose.data.noise import noise_of
from suite.diagnose.estimate.block import NormalEquations
from suite.diagnose.estimate.gauss_newton import intervals95
from suite.diagnose.evidence.rollouts import RolloutModel, rollout_evidence, start_estimate
from suite.experiments.bench import sysid_baseline
from suite.experiments.bench.compare import Comparison, compare_times, in_turn

SEED = 20_001
"""Seed of the true parameters, the flights and their noise. No blind case and no tuning of the
suite used it."""


def run(seed: int = SEED, duration_s: float = 10.0, rounds: int = 3) -> Comparison:
    """Time both fits in turn on five flights of `duration_s` [s], and compare their estimates.

    Raises:
        WorkFailed: if a package of `mujoco.sysid` is missing.
    """
    if not sysid_baseline.is_installed():
        raise WorkFailed(
            "mujoco.sysid lacks some of its packages: pip install 'diffracing-suite[sysid]'"
        )
    task = sysid_baseline.make_task(seed, duration_s)
    # Measured rotor speeds are the input of the simulation, as for the baseline.
    model = RolloutModel(task.nominal, rotor_input=True, voltage=False, integrator="euler")
    start = start_estimate(model, task.windows)
    residual = model.residual(start, task.windows)
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


def refit(model: RolloutModel, task: sysid_baseline.Task) -> tuple[np.ndarray, NormalEquations]:
    """Fit the K parameters as the diagnosis does.

    It estimates the noise, linearises the simulation with respect to the parameters and the start
    of every window, and makes Gauss-Newton steps. They use the part of the windows in which the
    linearisation is trusted. All this is repeated as long as that part grows.

    Returns:
        The fitted parameters (K,), and the normal equations of the last step.
    """
    indices, state = list(task.indices), start_estimate(model, task.windows)
    used_values = 0
    while True:
        directions = [*indices, *model.starts]
        linear = model.linearise(state, task.windows, directions)
        evidence, known = rollout_evidence(model, linear, along=indices)
        _, state, block = evidence.fitted(state, indices, known=known)
        if evidence.trusted.valid.sum() <= used_values:
            return state.theta[indices], block.equations
        used_values = evidence.trusted.valid.sum()


def _agreement(
    task: sysid_baseline.Task, answers: Mapping[str, tuple[np.ndarray, NormalEquations]]
) -> dict[str, Any]:
    """Return the parameters that each side fitted, and how far they are apart.

    The difference of the sides is divided by their joint 95 % half-width. The half-width of a side
    comes from the scatter between the windows. The joint one is the root sum of squares of both.
    """
    widths = {side: intervals95(equations).half_width for side, (_, equations) in answers.items()}
    our_values, their_values = (values for values, _ in answers.values())
    difference = np.abs(our_values - their_values) / np.hypot(*widths.values())
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
