"""Estimates the parameters of a vehicle file from flights, each with its interval."""
