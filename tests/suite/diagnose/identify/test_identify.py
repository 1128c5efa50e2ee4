"""Numbers of a known vehicle come back from its flights, each within its interval."""

import numpy as np
import pytest

from suite.diagnose.identify.identify import identify
from suite.diagnose.identify.numbers import as_json
from tests.support import identified as known

TRUE = {
    "motors.thrust": known.MOTORS.thrust,
    "motors.voltage_exponent": (known.MOTORS.voltage_exponent,),
    "effects.linear_drag.coefficient": known.DRAG,
    "inertia": known.vehicle().inertia,
    "rotors.thrust_coefficient": (known.vehicle().rotors.thrust_coefficient,),
    "rotors.torque_coefficient": (known.vehicle().rotors.torque_coefficient,),
    "rotors.time_constant": (known.vehicle().rotors.time_constant,),
    "effects.command_delay.delay": (known.DELAY,),
    "effects.thrust_scale.scale": (1.0,),
    "controller.rate_gain": known.vehicle().controller.rate_gain,
}


def pulls(found):
    """How many half-widths every told number is off, by key and component."""
    off = {}
    for entry in found.numbers:
        true = TRUE[entry.key]
        if entry.key == "motors.thrust":
            # At the start's nominal voltage.
            per = (15.0 / known.MOTORS.voltage) ** known.MOTORS.voltage_exponent
            true = (true[0] * per, true[1] * per**2)
        for k, (value, span) in enumerate(zip(entry.value, entry.ci95, strict=True)):
            if span is not None:
                off[entry.key, k] = (value - true[k]) / (0.5 * (span[1] - span[0]))
    return off


@pytest.mark.parametrize(("drive", "least"), [("rates", 9), ("pwm", 8), ("rotors", 5)])
def test_what_flights_tell_is_near_the_truth(drive, least):
    found = identify(known.logs(drive, 0), known.start())
    off = pulls(found)
    assert found.drive == drive
    assert len(off) >= least
    assert np.max(np.abs(list(off.values()))) < 2.5


@pytest.mark.slow
@pytest.mark.parametrize("drive", ["rates", "pwm", "rotors"])
def test_intervals_hold_the_truth_as_often_as_they_say(drive):
    inside = []
    for seed in range(1, 25):
        found = identify(known.logs(drive, seed), known.start())
        inside += [abs(pull) < 1.0 for pull in pulls(found).values()]
    assert len(inside) > 100
    assert 0.90 <= np.mean(inside) <= 0.985


def test_a_hover_tells_thrust_and_says_what_it_cannot():
    found = identify(known.logs("pwm", 0, known.HOVER), known.start())
    told = as_json(found.numbers)
    assert "motors.thrust" in told
    words = " ".join(found.untold)
    assert "drag along body x: too slow" in words
    assert found.vehicle.effects["linear_drag"].coefficient[:2] == (0.0, 0.0)


def test_what_is_left_alone_stays():
    begun = known.start()
    found = identify(known.logs("rates", 0), begun, leave=("drag", "loop"))
    assert "linear_drag" not in found.vehicle.effects
    assert found.vehicle.controller == begun.controller
