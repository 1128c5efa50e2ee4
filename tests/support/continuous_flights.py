"""Flights in continuous time by the engine of the blind cases, which shares no code with the model.

So the diagnosis is tested against the equations and not against its own code.
"""

import numpy as np

from eval.flights.simulate import Sensors
from eval.quadrotor.plant import Motion
from suite.blind.continuous.body import POS, QUAT, VEL, Battery
from suite.blind.continuous.engine import fly
from suite.blind.continuous.log import log_of_flight
from suite.blind.continuous.quadrotor import quadrotor_of
from suite.blind.continuous.timing import Conditions, schedule
from tests.support.diagnosis_flights import curve, on_curves, track
from tests.support.vehicles import with_effects, with_lag

CHANNELS = Sensors("", 100.0, pos=1.0, attitude=1.0, gyro=1.0, vel=1.0, acc=1.0)
"""A log of all but rotor speeds and voltage; it is without noise."""


def fly_finely(
    vehicle, seed, duration_s=4.0, rate_hz=100.0, jitter=0.3, speed=3.0,
    lag_s=0.0, delay_s=0.0, drag=(0.0, 0.0, 0.0), finest_s=5e-4,
):  # fmt: skip
    """Return the log of a flight whose rate loop starts its period anew at every row.

    The spacing of the rows is off by up to `jitter` of a row.
    """
    rng = np.random.default_rng(seed)
    path, count = curve(rng, speed), int(duration_s * rate_hz)
    stamps = (np.arange(count) + rng.uniform(-0.5, 0.5, count) * jitter) / rate_hz
    stamps -= stamps[0]
    truth = with_effects(with_lag(vehicle, lag_s), linear_drag=(drag,), command_delay=(delay_s,))

    def pilot(rows):
        order = track(on_curves(*path, rows.time_s[0]), 0.4, Motion(*rows[2:]))
        command = np.column_stack([order.thrust, order.rate_b])
        return command, command

    start = np.zeros((1, 13))
    start[0, POS], start[0, VEL], _ = on_curves(*path, 0.0)
    start[0, QUAT.start] = 1.0
    plan = schedule(stamps[:, None], 1.0 / vehicle.controller.frequency, delay_s, finest_s)
    flown = fly(quadrotor_of(truth), plan, start, pilot, rng, Battery(16.5, 0.0, 0.0))
    clean = Conditions(vehicle.controller.frequency, rate_hz, jitter, 0.0, 0.0, 0.0, 1.0)
    return log_of_flight(flown, 0, duration_s, {}, CHANNELS, clean, None, f"finely {seed}", {})
