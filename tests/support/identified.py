"""Simulated flights whose vehicle is known exactly, logged with noise, for `suite identify`."""

from dataclasses import replace
from functools import cache
from types import MappingProxyType

import numpy as np

from eval.effects import EFFECTS
from eval.flights.simulate import Sensors
from eval.flights.trajectory import Trajectory
from eval.vehicles.vehicle import MotorMap
from suite.diagnose.identify.fit import Fitted, Unknown
from suite.diagnose.identify.identify import identify
from tests.support import fleets
from tests.support.fleets import Fleet, logs_of, recordings_of

DRAG, DELAY = (0.3, 0.4, 0.2), 0.012
MOTORS = MotorMap(thrust=(1.1, 4.4), voltage=16.0, voltage_exponent=1.2)
SENSORS = Sensors(
    "tracked", 250.0, pos=0.004, attitude=0.01, gyro=0.06, vel=0.1, rotor=2.0, voltage=0.02
)
WAYS = (
    Trajectory("figure_eight", 6.5, 4.0, turn="sweep"),
    Trajectory("circle", 6.5, 3.0, turn="wobble"),
    Trajectory("climb", 6.5, 3.0, turn="wobble"),
    Trajectory("chirp", 6.0, 0.8),
)
HOVER = (Trajectory("hover", 8.0), Trajectory("vertical", 8.0, 0.5))


def vehicle():
    """Return the nominal quadrotor, with a table `[motors]`."""
    return replace(fleets.start(), motors=MOTORS)


def truth():
    """Return the true quadrotor: the same with drag and delay."""
    effects = {
        "linear_drag": EFFECTS["linear_drag"].values(DRAG),
        "command_delay": EFFECTS["command_delay"].values(DELAY),
    }
    return replace(vehicle(), effects=MappingProxyType(effects))


def start():
    """Return a start of `suite identify`: right mass and arms, and wrong numbers otherwise."""
    nominal = fleets.start()
    x, y, z = nominal.inertia
    return replace(
        nominal,
        inertia=(1.2 * x, y / 1.2, z),
        rotors=replace(nominal.rotors, time_constant=0.02),
        controller=replace(nominal.controller, rate_gain=(15.0, 25.0, 6.0)),
        motors=replace(nominal.motors, voltage=15.0),
    )


@cache
def recordings(ways):
    """Return the true states and inputs of the flights, at every step."""
    return recordings_of(Fleet(truth(), ways))


def logs(drive, seed, ways=WAYS, scale=1.0, sensors=SENSORS):
    """Return logs of the flights with noise, with the inputs that `drive` needs and no others."""
    fleet = Fleet(truth(), ways, scale)
    return logs_of(fleet, recordings(ways), drive, np.random.default_rng(seed), sensors=sensors)


@cache
def found(drive):
    """Return what is identified from seed 0: from the eight and the chirp, for rates from all."""
    return identify(logs(drive, 0)[:: 1 if drive == "rates" else 3], start())


def fitted(names, covariance=None, value=None, left=()):
    """Return a fit of these numbers that did not identify those that are `left`."""
    none = np.zeros(len(names))
    unknowns = tuple(Unknown(name, 0.0, -1.0, 1.0, 1.0, 1e-3) for name in names)
    covariance = np.diag(none) if covariance is None else np.asarray(covariance)
    return Fitted(unknowns, none if value is None else value, covariance, tuple(left))
