"""The free rigid body: what a tumbling one keeps."""

import numpy as np

from eval.quadrotor.plant import Wrench, euler_step, make_plant
from tests.support.vehicles import PLAIN, at_rest


def test_tumbling_keeps_angular_momentum_and_energy_to_first_order():
    inertia = np.array(PLAIN.inertia)
    start = at_rest()._replace(rate_b=np.array([3.0, 8.0, 1.0]))
    drifts = []
    for dt in (0.002, 0.001):
        plant, motion = make_plant(PLAIN, dt), start
        for _ in range(round(0.4 / dt)):
            motion = euler_step(plant, motion, Wrench(np.zeros(3), np.zeros(3)))
        momentum_w = motion.rot_w @ (inertia * motion.rate_b)
        energy = 0.5 * (inertia * motion.rate_b**2).sum()
        momentum_start, energy_start = (
            inertia * start.rate_b,
            0.5 * (inertia * start.rate_b**2).sum(),
        )
        drifts.append(
            [
                np.linalg.norm(momentum_w - momentum_start) / np.linalg.norm(momentum_start),
                abs(energy - energy_start) / energy_start,
            ]
        )
    assert np.max(drifts) < 0.02
    ratio = np.array(drifts[0]) / drifts[1]
    assert np.all((ratio > 1.7) & (ratio < 2.3)), ratio
