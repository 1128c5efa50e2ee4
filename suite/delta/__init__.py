"""Fitting a Delta Action Model to recorded flights (Su et al. 2026, Sec. III-D).

It is a network that adds a correction to the action, so that simulated flights match measured ones.
"""
