"""The judge: it flies trials of a policy in a simulator, scores them and computes statistics."""
