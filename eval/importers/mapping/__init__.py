"""Mapping files: which columns of a file are which signal, and how they become ours."""
