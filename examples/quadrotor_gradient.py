"""Differentiate a simulated flight with respect to a parameter of the vehicle, here its mass.

One second of commands is simulated. Newton's method finds the mass with which the flight ends where
that of a heavier drone ended. Run: python examples/quadrotor_gradient.py [STEPS]
"""

from __future__ import annotations

import sys

import jax
import jax.numpy as jnp
import numpy as np

from eval.effects.body import MassOffset
from eval.quadrotor.plant import Command, Motion, fit_plant
from eval.quadrotor.stepper import Inputs, rollout
from eval.quadrotor.vehicle_file import load_vehicle

SECONDS, DT = 1.0, 0.002
GRAVITY = 9.81


def main(steps: int) -> None:
    """Fit the mass by Newton's method with exact derivatives, in `steps` steps."""
    vehicle = load_vehicle("racer5")
    count = round(SECONDS / DT)
    thrust = jnp.full(count, 1.1 * GRAVITY)  # per nominal mass [m/s^2]
    rate_b = jnp.zeros((count, 3)).at[: count // 4, 1].set(0.8)  # nose down first [rad/s]
    inputs = Inputs(command=Command(thrust, rate_b))
    rest = Motion(np.array([0.0, 0.0, 2.0]), np.eye(3), np.zeros(3), np.zeros(3))

    def last_pos_w(mass: jax.Array) -> jax.Array:
        """Return where the drone is after the commands, (3,) [m], `mass` [kg] heavier."""
        plant = fit_plant(vehicle, {"mass_offset": MassOffset(mass)}, DT)
        return rollout(plant, rest, inputs).motion.pos_w[-1]

    @jax.jit
    def end_and_slope_w(mass: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return `last_pos_w` and its derivative with respect to the mass, (3,) [m/kg]."""
        return jax.jvp(last_pos_w, (mass,), (jnp.ones_like(mass),))

    true_mass = 0.06
    goal_w, _ = end_and_slope_w(jnp.float32(true_mass))
    mass = jnp.float32(0.0)
    for step in range(steps):
        end_w, slope = end_and_slope_w(mass)
        error = end_w - goal_w
        print(f"{step}: {float(mass):.5f} kg, {float(jnp.linalg.norm(error)):.2e} m off")
        mass = mass - slope @ error / (slope @ slope)
    ahead_w, behind_w = end_and_slope_w(mass + 1e-2)[0], end_and_slope_w(mass - 1e-2)[0]
    differences = (ahead_w - behind_w) / 2e-2
    exact, approximate = float(end_and_slope_w(mass)[1][2]), float(differences[2])
    print(f"{float(mass):.5f} kg; the truth is {true_mass} kg")
    print(f"d z / d mass: {exact:.3f} m/kg, by differences {approximate:.3f}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if sys.argv[1:] else 4)
