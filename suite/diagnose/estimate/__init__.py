"""Fits of parameters, their intervals, and tests of how much they explain by chance."""
