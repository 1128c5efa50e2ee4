"""Flies a policy in real time over MAVLink, on a vehicle or on a simulated one."""
