"""Policies: the observation, the networks, checkpoints and the shipped policies."""
