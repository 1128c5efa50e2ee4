"""How a command runs: one writer a folder, and signals that end it."""
