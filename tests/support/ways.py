"""Two short trajectories, and a bare quadrotor that flies them."""

import functools
from dataclasses import replace
from types import MappingProxyType

from eval.effects import EFFECTS
from eval.flights.simulate import fly
from eval.flights.trajectory import Trajectory
from suite.blind.oracle import nominal_vehicle

EIGHT = Trajectory("figure_eight", duration_s=2.5, speed=4.0, size=2.0, turn="wobble")
CIRCLE = Trajectory("circle", duration_s=2.5, speed=3.0, size=3.0)
BARE = nominal_vehicle("bare")


@functools.cache
def bare_flights():
    """Return `BARE` on both."""
    return fly(BARE, BARE, [EIGHT, CIRCLE])


def having(vehicle=BARE, **effects):
    """Return `vehicle` with further effects, each given as a tuple of its parameters."""
    values = {name: EFFECTS[name].values(*numbers) for name, numbers in effects.items()}
    return replace(vehicle, effects=MappingProxyType({**vehicle.effects, **values}))
