"""Fitting a Delta Action Model to recorded flights (Su et al. 2026, Sec. III-D).

The model is a network that adds a correction to each action of a policy, so that simulated flights
match measured ones.
"""
