"""The differentiable point-mass trainer: runs with jax, numpy and pure-Python packages only."""
