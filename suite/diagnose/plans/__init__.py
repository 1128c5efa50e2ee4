"""Commanded trajectories, flown in simulation, and which of them separate which effects."""
