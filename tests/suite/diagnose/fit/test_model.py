"""A fault of a log from another package is in the model and in the search, by its hooks alone."""

import jax
import numpy as np
import pytest

from eval.flights.simulate import SENSORS, fly, log_of
from eval.flights.trajectory import Trajectory, ordinary_flights
from suite.diagnose.data.windows import SLICES, cut
from suite.diagnose.diagnose import diagnose
from suite.diagnose.estimate.parameters import candidates, make_space
from suite.diagnose.evidence.rollouts import RolloutModel
from suite.diagnose.report.diagnosis_json import diagnosis_json
from suite.diagnose.verdict.rollout_gap import true_starts
from tests.support.faults import ImuFault, with_imu_fault
from tests.support.vehicles import PLAIN, with_effects, with_lag

GIVEN = with_lag(PLAIN, 0.02)
FAULT = {"imu_fault": ImuFault((0.01, -0.015, 0.02), 1.04, 0.01)}


@pytest.fixture(autouse=True)
def in_the_catalogue(monkeypatch):
    with_imu_fault(monkeypatch)


def logs_of(ways, rng):
    truth = with_effects(GIVEN, **FAULT)
    flights = fly(GIVEN, truth, ways, SENSORS["estimator"].rate_hz)
    return [log_of(f, truth, SENSORS["estimator"], rng, f"f{k}") for k, f in enumerate(flights)]


def test_the_simulated_log_has_it():
    """Residuals of a flight without noise all but vanish where the model has the true fault."""
    ways = [Trajectory("figure_eight", duration_s=4.0, speed=4.0, size=2.0, turn="wobble")]
    windows, _ = cut(logs_of(ways, None), GIVEN, False, integrator="euler")
    assert windows is not None
    space = make_space(GIVEN)
    model, start = RolloutModel(GIVEN, space, False, False, "euler"), space.array("start")
    true = start.copy()
    names = [(e.effect, e.parameter, e.component) for e in space.entries]
    for (parameter, component), value in {
        ("turn", 0): 0.01, ("turn", 1): -0.015, ("turn", 2): 0.02,
        ("scale", None): 1.04, ("late", None): 0.01,
    }.items():  # fmt: skip
        true[names.index(("imu_fault", parameter, component))] = value
    fly_model = jax.jit(model.fly)
    with jax.enable_x64(True):
        off = [
            np.asarray(fly_model(theta, true_starts(model, theta, windows), windows)[0])
            for theta in (start, true)
        ]
    for channel, share in {
        "position": 0.1,
        "attitude": 0.05,
        "velocity": 0.1,
        "rates": 0.1,
    }.items():
        before, after = (np.sqrt((o[..., SLICES[channel]] ** 2).mean()) for o in off)
        assert after < share * before, channel


def test_the_search_may_name_it():
    (one,) = [c for c in candidates(make_space(GIVEN), False, set()) if c.name == "imu_fault"]
    assert len(one.indices) == 5


@pytest.mark.slow
def test_the_diagnosis_finds_it():
    rng = np.random.default_rng(4)
    logs = logs_of(ordinary_flights(rng, duration_s=5.5), rng)
    found = diagnosis_json(diagnose(logs, GIVEN))
    assert [effect["name"] for effect in found["effects"]] == ["imu_fault"]
    (effect,) = found["effects"]
    assert effect["parameters"]["scale"]["value"] == pytest.approx(1.04, abs=0.004)
    assert effect["parameters"]["late"]["value"] == pytest.approx(0.01, abs=0.002)
    assert found["gap"]["after"] < 1.2
