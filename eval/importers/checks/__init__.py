"""Whether a log agrees with itself."""
