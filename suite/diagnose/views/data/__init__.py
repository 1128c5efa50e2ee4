"""Real flights made ready: completed, driven, smoothed."""
