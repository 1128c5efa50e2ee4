"""The race as environments of Gymnasium, Stable-Baselines3 and dm_control.

They use the vehicle, tracks and rules of the judge, which flies policies and scores them.
"""
