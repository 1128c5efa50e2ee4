"""Faults that are put into correct flights, and flights in the formats of other programs."""
