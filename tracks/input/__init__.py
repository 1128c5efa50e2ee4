"""Allowed ranges of settings, and safe readers of untrusted JSON and TOML files."""
