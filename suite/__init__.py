"""What a person runs: the command line, the trainer, the Delta Action loop and benchmarks."""
