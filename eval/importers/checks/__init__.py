"""Checks of an imported log against itself: time in flight, impossible samples, delays."""
