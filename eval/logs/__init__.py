"""Flights as logs: columns, rules and files."""
