"""The oracle of the blind cases: how well flights determine each parameter of an effect.

The oracle does not use the result of a diagnosis. It decides how strong the hidden effects are, and
which alternatives the answer of a case requires and allows.
"""
