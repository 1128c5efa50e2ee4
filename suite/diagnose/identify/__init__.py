"""Identifies the numbers of a vehicle file from flights, each with its interval."""
