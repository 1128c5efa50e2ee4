"""Recurrent PPO in the worlds and dynamics of the trainer, as a baseline."""
