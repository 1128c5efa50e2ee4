"""A simulator for blind cases in continuous time, which shares no code with the fitted model."""
