"""What flew, on an even grid: what was measured, and what drove it."""
