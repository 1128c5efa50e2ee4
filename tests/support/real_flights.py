"""Flights as real ones are: rotors measured, a trim of each flight's own, a load on a line."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from eval.effects.interface import GRAVITY
from eval.logs.flight_log import FlightLog
from tests.support.diagnosis_flights import fly_all
from tests.support.vehicles import PLAIN, with_effects, with_lag

VEHICLE = with_lag(replace(PLAIN, controller=replace(PLAIN.controller, frequency=300.0)), 0.03)
"""Its rate loop, of 300 Hz, needs three fifths of the steps of `PLAIN`'s."""
TRIM = 0.004
"""Standard deviation of each flight's own torque trim [N m]; of its centre of mass, a fifth [m]."""
GRAVITY_W = np.array([0.0, 0.0, -GRAVITY])


class Pendulum:
    """A point mass on a stiff line below the centre of mass; one object serves one flight.

    Along the unit vector q to the load the line pulls with m (L |q'|^2 + (g - a) . q); across it
    L q'' = (g - a) - ((g - a) . q) q - L |q'|^2 q, with the vehicle's acceleration a.
    """

    def __init__(self, mass, length, vehicle_mass, lean=(0.2, 0.1)):
        """`mass` and `vehicle_mass` [kg], `length` [m]; it starts at rest, leaning by `lean`."""
        self.mass, self.length, self.vehicle_mass = mass, length, vehicle_mass
        self.along = np.array([lean[0], lean[1], -1.0])
        self.along /= np.linalg.norm(self.along)
        self.turning = np.zeros(3)
        self.last = None

    def __call__(self, motion, time_s):
        """Return the acceleration that the line gives the vehicle in the world (3,) [m/s^2]."""
        if self.last is None:
            self.last = (time_s, motion.vel_w)
        step = time_s - self.last[0]
        acc_w = (motion.vel_w - self.last[1]) / step if step > 0.0 else np.zeros(3)
        self.last = (time_s, motion.vel_w)
        felt, q = GRAVITY_W - acc_w, self.along
        centre = self.length * self.turning @ self.turning
        pull = self.mass * max(centre + felt @ q, 0.0)
        self.turning = self.turning + step * ((felt - (felt @ q) * q - centre * q) / self.length)
        self.along = q + step * self.turning
        self.along /= np.linalg.norm(self.along)
        self.turning = self.turning - (self.turning @ self.along) * self.along
        return pull * q / self.vehicle_mass


def flights(
    count: int,
    seed: int = 0,
    duration_s: float = 8.0,
    speed: float = 3.0,
    trim: float = 1.0,
    hidden: Mapping[str, Any] | None = None,
    noise: float = 1.0,
    headings: Sequence[float] = (),
    load: tuple[float, float] | None = None,
    **effects: Any,
) -> list[FlightLog]:
    """Return logs of `VEHICLE` with effects, rotors measured, each with a trim of its own.

    Effects are `hidden` by name, and what is given by keyword. With `headings` [rad] the flights
    keep one each, in turn; a `load` of so many kg hangs on a line of so many metres.
    """
    effects = {**(hidden or {}), **effects}
    rng, vehicles, swings = np.random.default_rng(seed), [], []
    for _ in range(count):
        own = tuple((trim * TRIM * rng.standard_normal(3)).tolist())
        vehicles.append(with_effects(VEHICLE, **effects, torque_trim=(own,)))
        if load is not None:
            lean = tuple(rng.uniform(-0.25, 0.25, 2).tolist())
            swings.append(Pendulum(*load, VEHICLE.mass, lean))
    kept = [headings[number % len(headings)] for number in range(count)] if headings else None
    seeds = range(100 * seed, 100 * seed + count)
    logs = fly_all(
        vehicles, seeds, duration_s, speed, noise, motors=True, extras=swings, headings=kept
    )
    return [replace(log, about={}) for log in logs]
