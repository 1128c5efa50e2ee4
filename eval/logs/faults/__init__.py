"""Faults of a log's interface: units, frames, signs, orders, clocks, by name and with their fix."""
