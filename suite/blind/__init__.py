"""Blind tests of the diagnosis, which names physical effects that a vehicle file lacks.

Cases (simulated flights with a hidden effect) are made from seeds. They are diagnosed without their
answers, the true effects. Then the diagnoses are scored by the answers.
"""
