"""The differentiable trainer; it needs jax, numpy and pure-Python packages only."""
