"""Flights along x past gates, as the judge hands them out: straight, or with a circle."""

import numpy as np

from eval.logs.flight import Flight
from eval.worlds.trial import TrialSpec
from tests.support.loops import trial_result

GATES, STEP_M, RADIUS_M = 8, 5.0, 1.75
"""Gates, metres between them, and the radius of a circle [m]."""
POINTS = 801


def flown(lap_s, circles_at=None, success=True, trial=None):
    """Return a trial's result and flight at constant speed, with a circle before gate `circles_at`.

    One that fails ends at half of the way.
    """
    far = np.linspace(0.0, GATES * STEP_M, POINTS)
    pos_w = np.stack([far, 0.0 * far, 1.4 + 0.0 * far], axis=-1)
    gate = np.minimum((far / STEP_M + 1e-9).astype(int), GATES)
    if circles_at is not None:
        where = int(np.argmin(abs(far - (circles_at + 0.5) * STEP_M)))
        angle = np.linspace(0.0, 2 * np.pi, 200)
        circle = RADIUS_M * np.stack([np.sin(angle), 1 - np.cos(angle), 0.0 * angle], axis=-1)
        pos_w = np.concatenate([pos_w[:where], pos_w[where] + circle, pos_w[where + 1 :]])
        gate = np.concatenate([gate[:where], np.full(200, gate[where]), gate[where + 1 :]])
    count = len(pos_w)
    time_s = np.linspace(0.0, lap_s, count)
    vel_w = np.gradient(pos_w, axis=0) / (time_s[1] - time_s[0])
    if not success:
        count //= 2
    trial = trial or TrialSpec("zigzag", 0, 0)
    result = trial_result(trial.seed, success, trial.difficulty)._replace(
        track=trial.track, time_s=lap_s
    )
    none = np.zeros((count, 4))
    flight = Flight(
        time_s[:count], pos_w[:count], none, vel_w[:count], none[:, :3], none[:, 0], none[:, :3],
        none, none[:, :3], none[:, 0] > 0, gate[:count], None, {},
    )  # fmt: skip
    return result, flight
