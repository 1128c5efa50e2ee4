"""Sensors files that come with the suite."""
