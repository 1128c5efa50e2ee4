"""Flights as evidence on the model: rollouts of a second, force and torque."""
