"""What stands beside the names: the logs, where they disagree, the actuators, a black box."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from eval.logs.flight_log import FlightLog
from eval.logs.velocity import velocity_from_position
from suite.diagnose.checks.actuators import ActuatorMismatch, actuator_mismatches
from suite.diagnose.checks.black_box import BlackBoxComparisons
from suite.diagnose.checks.disagreement import Disagreement, find_disagreement
from suite.diagnose.checks.kinematics import Kinematics, LogFacts, check_kinematics, facts_of
from suite.diagnose.data.windows import FlightWindows, take
from suite.diagnose.verdict.diagnosis import Diagnosis
from suite.diagnose.verdict.gap import start_noise, true_starts


@dataclass(frozen=True)
class Checks:
    """All that a report shows besides the search."""

    facts: list[LogFacts]
    kinematics: Kinematics | None
    disagreement: Disagreement
    actuators: list[ActuatorMismatch]
    black_box: BlackBoxComparisons | None = None
    """Only where it was asked for: it takes minutes."""


def run_checks(diagnosis: Diagnosis) -> Checks:
    """Return what stands beside the names of `diagnosis`, but for the black box."""
    model, limits, logs = diagnosis.model, diagnosis.limits, diagnosis.logs
    windows = diagnosis.cut(limits.check_stride_s)
    residual = model.residual(
        diagnosis.start, true_starts(model, diagnosis.start, windows), windows
    )
    near = np.isfinite(residual).all(axis=(1, 2))
    near &= (np.abs(residual[..., :3]) < limits.diverged_m).all(axis=(1, 2))
    windows = take(windows, near)
    disagreement = find_disagreement(
        model,
        diagnosis.nominal,
        diagnosis.start,
        diagnosis.fitted,
        windows,
        diagnosis.sigma,
        _measured_start_noise(diagnosis, windows),
        limits,
    )
    return Checks(
        facts=[facts_of(log) for log in logs],
        kinematics=check_kinematics(logs, limits),
        disagreement=disagreement,
        actuators=actuator_mismatches(logs, diagnosis.nominal, limits),
    )


def _measured_start_noise(diagnosis: Diagnosis, windows: FlightWindows) -> np.ndarray:
    """Return the noise (F,) of what a rollout starts from.

    A velocity that was derived from positions is as noisy as the derivation makes it.
    """
    sigma = diagnosis.sigma.copy()
    if not np.isfinite(sigma[6:9]).all():
        sigma[6:9] = _derived_velocity_noise(diagnosis.logs) * sigma[:3]
    return start_noise(sigma, windows, diagnosis.model.free, diagnosis.limits)


def _derived_velocity_noise(logs: Sequence[FlightLog]) -> float:
    """Return the noise of a derived velocity over that of the positions [1/s]."""
    log = logs[0]
    draws = np.random.default_rng(0).standard_normal((len(log.time_s), 3))
    draws[~np.isfinite(log.pos_w)] = np.nan
    return float(np.nanstd(velocity_from_position(log.time_s, draws)))
