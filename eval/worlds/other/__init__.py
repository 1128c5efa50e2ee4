"""Worlds whose vehicle is flown by a simulator that nobody here wrote."""
