"""Injection of faults into correct flights, and writers for the log formats of other programs."""
