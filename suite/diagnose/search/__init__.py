"""What is missing: candidates, rivals, names."""
