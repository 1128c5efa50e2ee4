"""The dynamics of a training: the point mass or the quadrotor."""
