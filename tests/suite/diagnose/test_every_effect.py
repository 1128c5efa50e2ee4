"""Every effect of the catalogue, hidden at a usual size in flights of MuJoCo, is named alone."""

import numpy as np
import pytest

from eval.effects import EFFECTS
from suite.blind.sensors import SENSORS, log_of
from suite.diagnose.diagnose import diagnose
from suite.diagnose.plans.simulate import fly
from suite.diagnose.plans.trajectory import ordinary_flights
from suite.diagnose.report.diagnosis_json import diagnosis_json
from tests.support.vehicles import PLAIN, with_effects, with_lag

DRAG = {"linear_drag": ((0.3, 0.25, 0.15),), "quadratic_drag": ((0.012, 0.016, 0.03),)}
GIVEN = with_effects(with_lag(PLAIN, 0.02), **DRAG)
HIDDEN = {
    "linear_drag": ((0.4, 0.3, 0.2),),
    "quadratic_drag": ((0.02, 0.02, 0.03),),
    "rotor_drag": (2e-5,),
    "inflow": (5e-5,),
    "translational_lift": (0.01,),
    "blade_flapping": (5e-7,),
    "ground_effect": (4.0, 0.0635),
    "constant_wind": ((1.5, -1.0, 0.5),),
    "gusts": (0.8, 5.0),
    "motor_lag": (0.035,),
    "command_delay": (0.01,),
    "thrust_scale": (0.95,),
    "battery_sag": (0.005, 0.0),
    "mass_offset": (0.05,),
    "com_offset": ((0.004, -0.003, 0.0),),
    "torque_trim": ((0.003, -0.002, 0.001),),
    "inertia_scale": ((1.15, 0.9, 1.1),),
    "rotor_gyroscopic": (2e-5,),
    "rate_gain": ((0.85, 0.9, 1.1),),
    "angular_damping": ((0.6, 0.6, 0.4),),
    "weak_motor": ((1.0, 0.94, 1.0, 1.0),),
    "thrust_tilt": ((0.01, -0.008),),
    "gyro_bias": ((0.02, -0.01, 0.015),),
    "accelerometer_bias": ((0.15, -0.1, 0.1),),
    "frame_tilt": ((0.01, 0.008),),
    "clock_offset": (0.008,),
}
ALIKE = {
    "mass_offset": {"thrust_scale"},
    "thrust_scale": {"mass_offset"},
    "rotor_drag": {"linear_drag"},
}
"""What half a minute of flight may leave open."""


@pytest.fixture(scope="module")
def ways():
    return ordinary_flights(np.random.default_rng(5), duration_s=5.5)


def test_no_effect_is_forgotten():
    assert set(HIDDEN) == set(EFFECTS)


@pytest.mark.parametrize("name", HIDDEN)
def test_an_effect_is_named_alone(name, ways):
    truth = with_effects(GIVEN, **{**DRAG, name: HIDDEN[name]})
    rng = np.random.default_rng(list(EFFECTS).index(name))
    flights = fly(GIVEN, truth, ways, SENSORS["estimator"].rate_hz, rng=rng)
    logs = [
        log_of(flight, truth, SENSORS["estimator"], rng, f"flight_{k}")
        for k, flight in enumerate(flights)
    ]
    found = diagnosis_json(diagnose(logs, GIVEN))
    assert found["verdict"] in ("named", "partly"), found["unexplained"]
    assert [effect["name"] for effect in found["effects"]] == [name]
    (effect,) = found["effects"]
    assert set(effect["alternatives"]) <= ALIKE.get(name, set())
    if name != "gusts":
        assert found["gap"]["after"] < 1.2
    parameter = EFFECTS[name].parameters[0].name
    if name == "weak_motor":
        assert effect["parameters"]["index"]["value"] == 2
        assert effect["parameters"]["scale"]["value"] == pytest.approx(0.94, abs=0.005)
        return
    value = np.array(effect["parameters"][parameter]["value"], dtype=float)
    true = np.array(HIDDEN[name][0])
    neutral = np.array(getattr(GIVEN.effects.get(name), parameter, 0.0))
    scale = np.abs(true - neutral).max()
    seen = np.isfinite(value)
    assert np.abs(value - true)[seen].max() < (0.5 if name == "gusts" else 0.15) * scale
