"""What flights can say about each parameter, without a diagnosis."""
