"""What flights agree on: the model on their rows, its equations, searches for names."""
