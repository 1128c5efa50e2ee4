"""A simulator for blind cases in continuous time.

It shares no code with the model that the diagnosis fits, so an error in that model cannot hide.
"""
