"""Checks of what drives the vehicle: motors, motor commands, throttle and rate commands."""
