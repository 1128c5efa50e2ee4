"""Recordings, pictures and videos of trials, the flights of a policy along a track."""
