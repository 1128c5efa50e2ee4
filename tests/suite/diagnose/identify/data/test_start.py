"""Effects that are another word for a fitted number are in the number, and the vehicle the same."""

from dataclasses import replace

import numpy as np
import pytest

from eval.quadrotor.plant import make_plant
from suite.diagnose.identify.drive import unmodelled_effects, with_merged_effects
from suite.diagnose.identify.identify import identify
from tests.support import identified as known
from tests.support.vehicles import PLAIN, with_effects

SAID = with_effects(
    PLAIN,
    motor_lag=(0.05,),
    inertia_scale=((1.2, 0.9, 1.1),),
    rate_gain=((0.8, 1.0, 1.3),),
    thrust_scale=(0.9,),
    clock_offset=(0.01,),
)


def test_the_vehicle_flies_as_before():
    own = with_merged_effects(SAID, True)
    assert list(own.effects) == ["clock_offset"] == list(unmodelled_effects(own))
    before, after = (make_plant(vehicle, 0.002).constants for vehicle in (SAID, own))
    for name in (
        "inertia",
        "time_constant",
        "rate_gain",
        "thrust_coefficient",
        "torque_coefficient",
    ):
        np.testing.assert_allclose(getattr(after, name), getattr(before, name))


def test_a_scale_of_commanded_thrust_stays_where_no_motor_is_known():
    assert "thrust_scale" in with_merged_effects(SAID, False).effects


def test_a_scale_with_which_it_could_not_hover_is_refused_before_the_work():
    weak = with_effects(PLAIN, thrust_scale=(0.3,))
    slow = replace(weak, rotors=replace(weak.rotors, speed_max=1500.0))
    with pytest.raises(ValueError, match="plain with its thrust_scale: .*too weak to hover"):
        with_merged_effects(slow, True)
    assert with_merged_effects(slow, False) == slow


@pytest.mark.parametrize("drive", [pytest.param("rates", marks=pytest.mark.slow), "pwm"])
def test_it_makes_no_difference_how_the_start_says_a_number(drive):
    plain = known.start()
    said = with_effects(plain, rate_gain=((1.5, 0.8, 1.2),), inertia_scale=((0.9, 1.1, 1.0),))
    gain = tuple(np.divide(plain.controller.rate_gain, (1.5, 0.8, 1.2)).tolist())
    said = replace(
        said,
        inertia=tuple(np.divide(plain.inertia, (0.9, 1.1, 1.0)).tolist()),
        controller=replace(plain.controller, rate_gain=gain),
    )
    one, other = known.found(drive).vehicle, identify(known.logs(drive, 0), said).vehicle
    assert set(one.effects) == set(other.effects)
    np.testing.assert_allclose(other.inertia, one.inertia, rtol=1e-6)
    np.testing.assert_allclose(other.controller.rate_gain, one.controller.rate_gain, rtol=1e-6)
