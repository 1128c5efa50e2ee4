"""What flies in training: the point mass or the quadrotor."""
