"""Shared by all rooms: files, names, provenance, TOML."""
