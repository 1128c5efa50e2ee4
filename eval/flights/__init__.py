"""Trajectories, the controller that flies them in simulation, and noisy logs of the flights."""
