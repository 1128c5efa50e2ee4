"""A policy in real time at one end of a MAVLink link, a vehicle or a simulated one at the other."""
