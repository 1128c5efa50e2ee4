"""Tracks from TOML files and mesh files, and scenes as meshes and as MuJoCo models."""
