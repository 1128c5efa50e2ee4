"""Checks of times: stamps, and the delay and drift between pose and gyro."""
