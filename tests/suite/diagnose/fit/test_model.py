"""A fault of a log from another package is in the model and in the search, by its hooks alone."""

import jax
import numpy as np

from eval.flights.simulate import SENSORS, fly, log_of
from eval.flights.trajectory import Trajectory
from suite.diagnose.data.windows import SLICES, cut
from suite.diagnose.estimate.parameters import candidates, make_space
from suite.diagnose.evidence.rollouts import RolloutModel, compiled, true_starts
from tests.support.faults import with_imu_fault
from tests.support.vehicles import PLAIN, with_effects, with_lag

GIVEN = with_lag(PLAIN, 0.02)
TURN = (0.01, -0.015, 0.02)


def test_a_fault_from_a_package_is_a_candidate_and_in_the_simulated_log(
    monkeypatch, compiled_quickly
):
    """Residuals of a flight without noise nearly vanish where the model has the true fault."""
    with_imu_fault(monkeypatch)
    truth = with_effects(GIVEN, imu_fault=(TURN, 1.04, 0.01))
    way = Trajectory("figure_eight", duration_s=2.5, speed=4.0, size=2.0, turn="wobble")
    (flight,) = fly(GIVEN, truth, [way], SENSORS["estimator"].rate_hz)
    log = log_of(flight, truth, SENSORS["estimator"], None, "flight")
    windows, _ = cut([log], GIVEN, False, integrator="euler")
    space = make_space(GIVEN)
    (one,) = [c for c in candidates(space, False, set()) if c.name == "imu_fault"]
    assert len(one.indices) == 5
    model, start = RolloutModel(GIVEN, space, False, False, "euler"), space.array("start")
    true = start.copy()
    names = [(e.effect, e.parameter, e.component) for e in space.entries]
    for k, value in enumerate(TURN):
        true[names.index(("imu_fault", "turn", k))] = value
    true[names.index(("imu_fault", "scale", None))] = 1.04
    true[names.index(("imu_fault", "late", None))] = 0.01
    fly_model = jax.jit(compiled(space.layout, False, False, "euler")[0])
    with jax.enable_x64(True):
        off = [
            np.asarray(fly_model(model.given, theta, offset, windows)[0])
            for theta in (start, true)
            for offset in [true_starts(model, theta, windows)]
        ]
    for channel in ("position", "attitude", "velocity", "rates"):
        before, after = (np.sqrt((o[..., SLICES[channel]] ** 2).mean()) for o in off)
        assert after < (0.05 if channel == "attitude" else 0.1) * before, channel
