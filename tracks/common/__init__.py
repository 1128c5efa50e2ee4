"""Shared by the whole project: files, names, provenance, TOML."""
