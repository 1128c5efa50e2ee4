"""Prepares flight logs for fits: windows of 1 s, measurement noise, held-out flights."""
