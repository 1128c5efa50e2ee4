"""The comparison's baseline: recurrent PPO in the trainer's worlds and dynamics."""
