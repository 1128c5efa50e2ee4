"""Identifies error models of on-board state estimates, from flights with a reference pose."""
