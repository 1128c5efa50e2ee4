"""Faults of an interface put into good flights, and flights as other programs write them."""
