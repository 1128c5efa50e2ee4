"""The error for a policy that cannot be used: a person's mistake, so its message is for people."""

from __future__ import annotations


class PolicyError(ValueError):
    """A policy or checkpoint is refused; the message names it, the fault and what to do next."""
