"""Ranges of settings, and safe readers of untrusted files."""
