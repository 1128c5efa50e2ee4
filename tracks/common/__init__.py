"""What every room leans on: files, names, provenance, TOML."""
