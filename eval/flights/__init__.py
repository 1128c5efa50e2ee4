"""Commanded trajectories, flown in simulation and logged with noise."""
