"""Flies trials of a policy, judges them and computes the statistics."""
