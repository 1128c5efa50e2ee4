"""The running of a command: folder locks, signals, several processes and hosts."""
