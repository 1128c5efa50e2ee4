"""How a command runs: folder locks, signals, several processes and hosts."""
