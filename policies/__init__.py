"""Who flies: the observation, the networks, checkpoints and the policies that are shipped."""
