"""The differentiable trainer: trains a policy by gradients through simulated flights.

It needs jax, numpy and pure-Python packages only.
"""
