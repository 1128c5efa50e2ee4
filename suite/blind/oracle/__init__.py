"""The oracle of the blind cases: how well flights determine each parameter of an effect.

It is computed without a diagnosis, and decides which names an answer allows.
"""
