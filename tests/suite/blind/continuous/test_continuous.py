"""The engine shares nothing with the model that fits, and converges."""

from pathlib import Path

import numpy as np
import pytest

import suite.blind.continuous
from suite.blind.continuous.body import POS, QUAT, RATE, VEL
from suite.blind.continuous.timing import Conditions
from suite.blind.continuous_flight import fly_continuous, with_loop
from suite.diagnose.plans.simulate import SENSORS
from suite.diagnose.plans.trajectory import Trajectory
from tests.suite.test_imports import imported
from tests.support.vehicles import PLAIN, with_effects, with_lag

FOLDER = Path(suite.blind.continuous.__file__).parent
ALLOWED = ("suite.blind.continuous", "eval.vehicles.vehicle", "eval.logs.flight_log")
"""What of the house the engine may know: its own folder, and the numbers of vehicles and logs."""
WAYS = (
    Trajectory("figure_eight", 0.8, speed=6.0, size=3.0, turn="wobble", height=0.5),
    Trajectory("low", 0.8, speed=1.5, size=1.0, height=0.14),
)


def test_no_module_of_the_engine_imports_the_model_that_fits():
    for path in FOLDER.glob("*.py"):
        for name in imported(path):
            if name.split(".")[0] in ("eval", "suite", "tracks", "policies"):
                assert name.startswith(ALLOWED), f"{path.name} imports {name}"


@pytest.mark.parametrize("lag", [pytest.param(0.0, marks=pytest.mark.slow), 0.02])
def test_a_finer_step_changes_a_flight_by_far_less_than_the_noise(lag):
    truth = with_effects(
        with_lag(PLAIN, lag),
        linear_drag=((0.3, 0.2, 0.1),),
        quadratic_drag=((0.03, 0.02, 0.04),),
        inflow=(4e-4,),
        ground_effect=(4.0, 0.0635),
        blade_flapping=(1e-6,),
        command_delay=(0.0123,),
        battery_sag=(0.005, 0.0),
        rotor_gyroscopic=(2e-5,),
    )
    conditions = Conditions(333.0, 97.0, 0.3, 0.0, 0.0, 0.0, 0.1)

    def rows(step_s):
        flown = fly_continuous(
            PLAIN, truth, WAYS, conditions, np.random.default_rng(3), step_s=step_s
        )
        return flown.state[flown.schedule.block[:-1]], flown.acc_b

    (coarse, acc), (fine, fine_acc) = rows(1e-3), rows(5e-4)
    noise = SENSORS["full"]
    apart = np.abs(coarse - fine).max(axis=(0, 1))
    assert len(coarse) > 100
    assert apart[POS].max() < 1e-4 * noise.pos
    assert apart[VEL].max() < 1e-4 * noise.vel
    assert apart[QUAT].max() < 1e-4 * noise.attitude
    assert apart[RATE].max() < 1e-4 * noise.gyro
    assert np.abs(acc - fine_acc).max() < 1e-4 * noise.acc


def test_the_error_falls_with_the_fourth_power_of_the_step():
    # Without ticks in between: a loop as slow as the rows, so that steps are as long as allowed.
    truth = with_lag(with_effects(quadratic_drag=((0.5, 0.4, 0.3),)), 0.02)
    conditions = Conditions(50.0, 50.0, 0.0, 0.0, 0.0, 0.0, 0.1)

    def last(step_s):
        flown = fly_continuous(
            with_loop(PLAIN, 50.0), truth, WAYS[:1], conditions, np.random.default_rng(3),
            step_s=step_s,
        )  # fmt: skip
        return flown.state[-1, 0, VEL]

    exact = last(2.5e-4)
    coarse, fine = (np.abs(last(step_s) - exact).max() for step_s in (4e-3, 2e-3))
    assert 12.0 < coarse / fine < 20.0
