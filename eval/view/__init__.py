"""Recordings, pictures and videos of trials."""
