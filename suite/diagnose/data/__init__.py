"""Flight logs as what is fitted to: windows, noise, hold-out."""
