"""Fitting a Delta Action Model to recorded flights (Su et al. 2026, Sec. III-D)."""
