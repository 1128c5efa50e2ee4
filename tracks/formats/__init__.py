"""Scenes in other formats: track files, meshes, MuJoCo."""
