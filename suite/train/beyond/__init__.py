"""What comes after a rollout: its value, and worlds that the next rollout goes on with."""
