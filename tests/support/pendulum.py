"""A load that hangs on a line under a vehicle, by the equations of a pendulum in a moving frame."""

import numpy as np

from eval.effects.interface import GRAVITY

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
