"""Recurrent PPO (proximal policy optimisation) in the worlds and dynamics of the trainer.

It is the baseline of the differentiable trainer.
"""
