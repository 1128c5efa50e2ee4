"""Blind tests of the diagnosis, which names physical effects that a vehicle file lacks.

Cases with hidden effects are made from seeds, diagnosed without their answers, and scored.
"""
