"""The loop (`suite loop`): correct a simulation from flights, and fine-tune a policy in it.

Its stages are: train, fly, record flights, diagnose them or fit a Delta Action Model (a network
that corrects actions), fine-tune, fly again.
"""
