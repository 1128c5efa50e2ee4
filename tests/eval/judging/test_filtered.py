"""The estimator in the loop: consistent in judged flights, and set by the trial alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from eval.judging import filtered, judge
from eval.judging.filtered import Filtered, inertial
from eval.judging.judge import JudgeOptions, fly
from eval.quadrotor.vehicle_file import load_vehicle
from eval.sensors.filter.kalman import error_of, update_gate
from eval.sensors.sensors_file import SensorSet, load_sensors, sensor_set
from eval.worlds.trial import Rules, TrialResult, TrialSpec
from policies.observation import View
from policies.spec import PolicySpec
from tests.support.pilots import Pursuit
from tracks.geometry.camera import Camera
from tracks.geometry.rotation import exp_rot

VEHICLE = load_vehicle("reference")
SPEC = PolicySpec(rate_hz=31.25, camera=Camera(width=4, height=4))
DELAY_S = 1.0 / SPEC.rate_hz
"""One period: the truth at the filter's horizon is what was seen at the decision before."""
TRIALS = [TrialSpec(track, 0, seed) for track in ("circular", "zigzag") for seed in range(20)]


def sensors(**changed: float) -> SensorSet:
    """Return the shipped sensors, with what is changed of the filter."""
    shipped = {k: values._asdict() for k, values in load_sensors("imu+gates").models.items()}
    return sensor_set({**shipped, "gate_filter": shipped["gate_filter"] | changed})


def flown(
    wanted: SensorSet,
    trials: list[TrialSpec],
    monkeypatch: Any,
    slots: int = 40,
    seconds: float = 1.6,
) -> tuple[list[TrialResult], np.ndarray]:
    """Return the results, and the NEES (T, N) of position, velocity and attitude."""
    found: list[np.ndarray] = []

    class Watched(Filtered):
        def see(self, view: View, truth: View, fresh: np.ndarray, flying: np.ndarray) -> View:
            seen = super().see(view, truth, fresh, flying)
            assert self.filters is not None and self._truth is not None
            past.append(View(*self._truth))
            if len(past) > 1:
                state, (pos_w, rot_w, vel_w, *_) = self.filters.state, past[-2]
                true = state._replace(pos_w=pos_w, rot_w=rot_w, vel_w=vel_w)
                error = error_of(state, true)[:, :9, None]
                covariance = state.covariance[:, :9, :9]
                value = (error * np.linalg.solve(covariance, error)).sum((1, 2))
                found.append(np.where(flying, value, np.nan))
            return seen

    past: list[View] = []
    monkeypatch.setattr(judge, "Filtered", Watched)
    options = JudgeOptions(slots=slots, sensors=wanted, rules=Rules(time_limit_s=seconds))
    results = fly(Pursuit(spec=SPEC), trials, VEHICLE, options=options)
    return results, np.array(found)


def share_within(found: np.ndarray) -> float:
    """Return the share of times, after a second, at which the mean NEES is within its bounds."""
    late = found[30:]
    flying = np.isfinite(late).sum(axis=1)
    low, high = (chi2.ppf(share, 9 * flying) / flying for share in (0.025, 0.975))
    mean = np.nanmean(late, axis=1)

    return float(np.mean((low < mean) & (mean < high)))


def test_nees_in_judged_flights_is_within_its_bounds(monkeypatch):
    _, found = flown(sensors(delay=DELAY_S), TRIALS, monkeypatch)
    assert share_within(found) > 0.9


def test_it_leaves_them_where_the_corners_variance_is_taken_for_a_fourth(monkeypatch):
    def sure(state: Any, corners: Any, variance: float, camera_b: Any) -> Any:
        return update_gate(state, corners, variance / 4.0, camera_b)

    monkeypatch.setattr(filtered, "update_gate", sure)
    _, found = flown(sensors(delay=DELAY_S), TRIALS, monkeypatch)
    assert share_within(found) < 0.5


def test_an_ideal_imu_reads_nothing_in_free_fall_and_the_turn():
    rng = np.random.default_rng(0)
    rot_w, turn_b = exp_rot(rng.normal(size=(5, 3))), 0.04 * rng.normal(size=(5, 3))
    none = (np.zeros((5, 3)),) * 4
    before = View(np.zeros((5, 3)), rot_w, np.ones((5, 3)), *none)
    fallen = np.ones((5, 3)) - [0.0, 0.0, 9.81 * 0.002]
    after = View(np.zeros((5, 3)), rot_w @ exp_rot(turn_b), fallen, *none)
    found = inertial(before, after, 0.002)
    np.testing.assert_allclose(found.acc_b, 0.0, atol=1e-9)
    np.testing.assert_allclose(found.rate_b, turn_b / 0.002, atol=1e-6)


def test_a_trials_outcome_is_the_same_at_any_batch(monkeypatch):
    together, _ = flown(sensors(), TRIALS[:2], monkeypatch, 2, 0.6)
    alone, _ = flown(sensors(), TRIALS[:2], monkeypatch, 1, 0.6)
    assert together == alone


def test_what_has_no_estimator_refuses_it(monkeypatch):
    wanted = load_sensors("imu+gates")
    with pytest.raises(ValueError, match="world 'reference' has no state estimator"):
        fly(Pursuit(spec=SPEC), TRIALS[:1], VEHICLE, "reference", JudgeOptions(sensors=wanted))
    models = {name: values._asdict() for name, values in wanted.models.items()}
    late = sensor_set({**models, "delay": {"state": 0.02}})
    with pytest.raises(ValueError, match=r"delay.state is 0.02 s, but the estimator"):
        flown(late, TRIALS[:1], monkeypatch)
