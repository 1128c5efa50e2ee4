"""Two short published flights of a real quadrotor, without their time on the ground."""
