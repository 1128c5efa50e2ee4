"""Seeing trials: a rerun recording, pictures and a video."""
