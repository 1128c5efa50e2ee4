"""Vehicles for tests, described here and not read from the shipped files."""

from dataclasses import replace
from typing import Any

import numpy as np

from eval.effects import EFFECTS
from eval.quadrotor.loops import KINDS
from eval.quadrotor.plant import Motion
from eval.vehicles.vehicle import Controller, Rotors, Vehicle

PLAIN = Vehicle(
    name="plain",
    mass=0.75,
    inertia=(0.0025, 0.0021, 0.0043),
    rotors=Rotors(
        position=((0.075, -0.1, 0.0), (-0.075, -0.1, 0.0), (-0.075, 0.1, 0.0), (0.075, 0.1, 0.0)),
        spin=(1, -1, 1, -1),
        thrust_coefficient=1.6e-6,
        torque_coefficient=2.2e-8,
        time_constant=0.0,
        speed_max=2100.0,
    ),
    controller=Controller(rate_gain=(20.0, 20.0, 8.0), frequency=500.0),
)
"""Rotors without lag, no effects."""
FIRMWARES = {"kind": "crazyflie", "settings": KINDS["crazyflie"].Settings()}
REMEMBERING = replace(
    PLAIN, controller=replace(PLAIN.controller, rate_gain=(1.0, 1.0, 1.0), **FIRMWARES)
)
"""With a firmware's rate loop: integrators and filters that no log tells of."""


def with_effects(vehicle: Vehicle = PLAIN, **values: Any) -> Vehicle:
    """Return `vehicle` with effects, each given as a tuple of its parameters."""
    effects = {name: EFFECTS[name].values(*parameters) for name, parameters in values.items()}
    return replace(vehicle, effects=effects)


def with_lag(vehicle, time_constant):
    """Return `vehicle` with another rotor time constant [s]."""
    return replace(vehicle, rotors=replace(vehicle.rotors, time_constant=time_constant))


LAGGED = with_lag(PLAIN, 0.03)


def at_rest(height=1.0):
    """Return a level body at rest."""
    return Motion(np.array([0.0, 0.0, height]), np.eye(3), np.zeros(3), np.zeros(3))


def drawn_effects(rng, vehicle=PLAIN):
    """Return values of the whole catalogue, each of typical strength and random sign."""
    drawn = {}
    for name, effect in EFFECTS.items():
        values = []
        for parameter in effect.parameters:
            neutral = parameter.neutral
            base = neutral(vehicle) if callable(neutral) else neutral
            low = parameter.low(vehicle) if callable(parameter.low) else parameter.low
            size = rng.uniform(*parameter.typical, size=parameter.size or None)
            sign = rng.choice([-1.0, 1.0], size=parameter.size or None) if low < base else 1.0
            value = size if parameter.whole else base + sign * size
            values.append(tuple(value.tolist()) if parameter.size else float(value))
        drawn[name] = tuple(values)
    return with_effects(vehicle, **drawn)
