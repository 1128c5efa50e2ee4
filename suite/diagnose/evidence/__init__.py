"""Differences of flights and simulation: by rollouts (simulated 1 s), by force and by torque."""
