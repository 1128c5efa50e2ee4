"""Tracks: gates, obstacles, track families and the geometry of a scene."""
