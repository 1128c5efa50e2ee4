"""Commanded trajectories, flown in simulation, and which of them tell which effects apart."""
