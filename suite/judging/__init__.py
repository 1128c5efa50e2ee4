"""What `suite eval`, `collect` and `view` do."""
