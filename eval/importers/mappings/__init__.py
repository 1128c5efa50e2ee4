"""Mapping files that come with the suite, by name."""
