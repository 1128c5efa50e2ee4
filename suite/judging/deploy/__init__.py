"""Exports a policy, checks the exported files, and measures their speed."""
