"""Three short flights with something hidden in them, and the vehicle file that lacks it."""
