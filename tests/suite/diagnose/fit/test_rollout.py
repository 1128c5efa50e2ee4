"""The model of a window against flights integrated finely, at any spacing of rows and any loop."""

from dataclasses import replace
from functools import cache

import jax
import numpy as np
import pytest

from suite.diagnose.data.windows import KNOTS, SLICES, STATE, cut
from suite.diagnose.estimate.parameters import make_space
from suite.diagnose.evidence.linearise import arrays_of
from suite.diagnose.evidence.rollouts import compiled, rollouts_along
from tests.support.continuous_flights import fly_finely
from tests.support.diagnosis_flights import NOISE
from tests.support.vehicles import PLAIN, with_effects

DRAG = (0.3, 0.35, 0.1)
flown = cache(lambda layout: jax.jit(compiled(layout, False, False, "continuous")[0]))


CHANNELS = {"position": "pos", "attitude": "att", "velocity": "vel", "rates": "rate",
            "accelerometer": "acc"}  # fmt: skip


@pytest.mark.usefixtures("compiled_quickly")
@pytest.mark.parametrize(
    ("frequency", "rate_hz", "lag", "delay"),
    [
        (500.0, 50.0, 0.03, 0.0273),
        # A delay of part of a step, which no lag smooths.
        (500.0, 100.0, 0.0, 0.0013),
        pytest.param(1000.0, 100.0, 0.015, 0.0, marks=pytest.mark.slow),
        pytest.param(2000.0, 100.0, 0.0, 0.01, marks=pytest.mark.slow),
        pytest.param(200.0, 100.0, 0.03, 0.0273, marks=pytest.mark.slow),
        pytest.param(500.0, 500.0, 0.03, 0.005, marks=pytest.mark.slow),
        pytest.param(1000.0, 1000.0, 0.03, 0.005, marks=pytest.mark.slow),
    ],
)
def test_a_second_of_flight_is_met_within_a_tenth_of_the_noise(frequency, rate_hz, lag, delay):
    vehicle = replace(PLAIN, controller=replace(PLAIN.controller, frequency=frequency))
    log = fly_finely(vehicle, 1, 2.5, rate_hz, 0.3, 3.0, lag, delay, DRAG, 1e-3)
    late = {"command_delay": (delay,)} if delay else {}
    truth = with_effects(vehicle, linear_drag=(DRAG,), motor_lag=(lag,), **late)
    windows, _ = cut([log], truth, False)
    assert windows is not None and len(windows.flight) == 2
    space, start = make_space(truth), np.zeros((len(windows.flight), STATE + 4))
    with jax.enable_x64(True):
        off, _ = flown(space.layout)(arrays_of(truth, space), space.array("start"), start, windows)
    for name, short in CHANNELS.items():
        error = float(np.sqrt((np.asarray(off)[..., SLICES[name]] ** 2).mean()))
        assert error < 0.1 * NOISE[short], name


def test_rollouts_begin_at_the_file_and_the_measured_states_of_the_windows(log):
    model, windows, start = rollouts_along([log], PLAIN, True, stride_s=0.5)
    assert len(windows.flight) > len(rollouts_along([log], PLAIN, True)[1].flight) > 0
    assert np.array_equal(start.theta, make_space(PLAIN).array("start"))
    assert start.free.shape == (len(windows.flight), STATE + 4 * KNOTS) and not start.free.any()
    assert len(model.starts) == start.free.shape[1]
    with pytest.raises(ValueError, match=r"no stretch of 1\.\d+ s in flight without a hole"):
        rollouts_along(
            [fly_finely(PLAIN, 1, 0.5, 100.0, 0.3, 3.0, 0.0, 0.0, DRAG, 1e-3)], PLAIN, False
        )
