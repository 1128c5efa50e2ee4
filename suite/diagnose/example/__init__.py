"""Three short flights of a vehicle with a hidden effect, and a vehicle file without it."""
