"""Flights as real ones are: rotors measured, and a trim of each flight's own."""

from dataclasses import replace

import numpy as np

from tests.support.diagnosis_flights import fly
from tests.support.vehicles import PLAIN, with_effects, with_lag

VEHICLE = with_lag(PLAIN, 0.03)
TRIM = 0.004
"""Standard deviation of each flight's own torque trim [N m]; of its centre of mass, a fifth [m]."""


def flights(count, seed=0, duration_s=8.0, speed=3.0, trim=1.0, **effects):
    """Return logs of `VEHICLE` with `effects`, rotors measured, each with a trim of its own."""
    rng, logs = np.random.default_rng(seed), []
    for number in range(count):
        own = tuple((trim * TRIM * rng.standard_normal(3)).tolist())
        true = with_effects(VEHICLE, **effects, torque_trim=(own,))
        log = fly(true, 100 * seed + number, duration_s, speed, motors=True)
        logs.append(replace(log, about={}))
    return logs
