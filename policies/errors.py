"""The errors of policies: a person's mistake, or a model's failure; the message is for people."""

from __future__ import annotations


class PolicyError(ValueError):
    """A policy or checkpoint is refused; the message names it, the fault and what to do next."""


class NeedsTrust(PolicyError):
    """A file is refused since loading it can run its maker's code, and nobody said to trust it."""


class NoAnswer(PolicyError):
    """A policy that was loaded gave no answer: it failed, or did not come to an end in time."""
